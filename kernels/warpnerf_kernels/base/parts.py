"""What the parts of a model are: the interfaces that ``launch.assembly`` puts together.

Each part has a scalar form, which runs on CUDA, in float64 and wherever a vector form is missing,
and may have a vector form for the CPU: sixteen samples, or the rows of a batch, at a time. Adjoints
stand directly below. Parts are values that Python can hash, so that kernels made of them are kept.
A part that differs from another in some functions is ``other.but(name=function)``: it has no vector
form, unless it is given one too, since that of the other would not do the same.

Names of arguments in the signatures below:

    params      what the part reads, a Warp struct of its own
    position    of a sample, folded coordinates c (base.types)
    raw         what a field holds at a sample, ``vector(n_floats)``: raw density first
    channels    what is added up along a ray, ``vector(n_channels)``
    gradient    ``base.types.gradient_type``: added to
    packs, slot scratch of a CPU worker: sixteen steps, see volume.pack
    rows, row   scratch of a CPU worker: what belongs to a ray, see volume.walk_packs
"""

from typing import Any, NamedTuple


class Sampler(NamedTuple):
    """Where the steps of a ray lie."""

    Params: Any
    """Struct, with near, far and transmittance_min among its fields."""
    interval: Any
    """(params, ray, step) -> vec2: where a step begins, and its length."""
    edge: Any
    """(params, ray, step) -> t at which a step begins; of the last one plus one, where they end."""
    steps_within: Any
    """(params, ray, interval of t) -> vec2i: the first step that can lie in it, one past the last.
    The ray's own begin and end are not known yet."""
    step_after: Any
    """(params, ray, t, step) -> the first step after `step` whose sample may lie at t or beyond."""
    longest: Any
    """(params, box, c, contraction) -> the longest step whose sample can lie where no folded
    coordinate is larger than c: cells that are free have to be so for it."""
    place_pack: Any = None
    """Vector form of interval: (params, ray, step, packs, slot) places sixteen steps."""

    def but(self, **changes: Any) -> "Sampler":
        """The same with other functions; see above."""
        return self._replace(**{"place_pack": None, **changes})


class EncodingVectors(NamedTuple):
    """The vector form of an encoding."""

    read_pack: Any
    """Of read: (params, ray, packs, slot), from x, y, z of a pack to its raw."""
    adj_read_pack: Any
    """Of adj_read: (params, packs, slot, later, worker, sink) adds a pack's adj_raw where the
    worker owns what it was read from, and leaves a record of the rest."""
    fetch_pack: Any
    """(params, packs, slot, worker, sink) asks for the memory that adj_read_pack will change, of a
    ray's first packs; adj_read_pack asks for that of later ones."""
    add_records: Any
    """(params, worker, sender, sink) adds what a sender has left for a worker."""
    Record: Any
    """Struct of what a pack leaves for other workers."""
    n_by_lane: int
    """How many numbers of raw lie lane by lane in a pack's raw and adj_raw: all, or the first four.
    Then all of raw lies sample by sample in ``by_sample``, and the head leaves the adjoint of those
    after the first four in ``adj_by_sample``, zeros where there is none."""
    pack_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a pack that are its own: names and types."""


class Encoding(NamedTuple):
    """What is stored over space, and how it is read."""

    n_floats: int
    """Numbers read at a position: raw density, features, and padding that nothing looks at."""
    Params: Any
    """Struct of the stored values."""
    read: Any
    """(params, position) -> raw."""
    adj_read: Any
    """(params, position, adj_raw, gradient) hands adj_raw to what it was read from."""
    place: Any
    """(params, position) -> where it lies in the field, [0, 1]^3; workers own parts along the first
    axis, and take rays by it."""
    vectors: EncodingVectors | None = None
    """The vector form, if it has one."""

    def but(self, **changes: Any) -> "Encoding":
        """The same with other functions; see above."""
        return self._replace(**{"vectors": None, **changes})


class HeadVectors(NamedTuple):
    """The vector form of a head."""

    begin_rows: Any
    """(params, worker) before the first row of a launch."""
    prepare_row: Any
    """Of prepare: (params, rows, row) for a ray, from its direction."""
    adj_prepare_row: Any
    """Of adj_prepare: (params, rows, row, worker, gradient)."""
    decode_pack: Any
    """Of decode: (params, rows, row, packs, slot, n) for n packs of a ray, from raw and weight to
    channel."""
    adj_decode_pack: Any
    """Of adj_decode: (params, rows, row, packs, slot, n, worker, gradient) from weight, scale and
    the row's adj_channels to adj_raw, but for the density's."""
    shade_rows: Any
    """Of shade: (params, rows, row, n) for n rays, from channels and transmittance to rgb."""
    adj_shade_rows: Any
    """Of adj_shade: (params, rows, row, n, worker, gradient) from adj_rgb to adj_channels and
    adj_opacity."""
    pack_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a pack that are its own: names and types."""
    row_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a row that are its own."""
    n_packs: int = 1
    """Packs of a ray that are decoded together, at most."""
    batch: int = 1
    """Rays whose rows are shaded together."""
    adj_decode_pack_with_colours: Any = None
    """adj_decode_pack where the loss is on samples as well: what flows back to a sample's colour is
    the row's adj_channels, and its sample_slope times the colour's difference from target_rgb. For
    heads of samples; with such a loss, one without it runs in the scalar form."""

    def but(self, **changes: Any) -> "HeadVectors":
        """The same with other functions. ``adj_decode_pack_with_colours`` has to be given, too:
        that of the other would not do the same.
        """
        return self._replace(**{"adj_decode_pack_with_colours": None, **changes})


class Head(NamedTuple):
    """From features of samples to channels that are added up along the ray, and on to colour.

    A head of samples decodes each one's features to red, green and blue, and hands on what was
    added up as it is. A head of rays adds up features, and shades each ray once.
    """

    n_channels: int
    """Channels added up along a ray."""
    Params: Any
    """Struct of what the head reads besides features: the weights of an MLP, or Nothing."""
    View: Any
    """Vector type of what depends on the direction of view, worked out once a ray."""
    prepare: Any
    """(params, direction) -> view."""
    adj_prepare: Any
    """(params, direction, adj_view, gradient) once a ray, after its samples."""
    decode: Any
    """(params, view, raw) -> channels of a sample, each of which lies in [0, 1]: what lies behind a
    sample is bounded by that, see volume.walk.behind_limit."""
    adj_decode: Any
    """(params, view, raw, channels, adj_channels, gradient) -> adj_raw, whose first entry, that of
    the density, is 0, and adj_view."""
    shade: Any
    """(params, direction, channels, opacity) -> rgb before the background, once a ray."""
    adj_shade: Any
    """(params, direction, channels, opacity, adj_rgb, gradient) -> adj_channels, adj_opacity."""
    weight_min: float = -1.0
    """Samples of no more weight are not decoded: their channels are 0."""
    vectors: HeadVectors | None = None
    """The vector form, if it has one."""

    def but(self, **changes: Any) -> "Head":
        """The same with other functions; see above."""
        return self._replace(**{"vectors": None, **changes})


class RayLossVectors(NamedTuple):
    """The vector form of a loss on the ray: sixteen samples at a time. Steps that are no samples
    have a weight of 0; what a loss adds for them is not looked at."""

    add_pack: Any
    """Of add: (params, state, packs, slot) -> state with a pack's samples."""
    adj_add_pack: Any
    """Of adj_weight and adj_density: (params, total, before, adj_value, packs, slot) adds, times
    adj_value, to the pack's adj_weight, and if the loss has adj_density to its adj_density. Returns
    the state with the pack's samples."""
    pack_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a pack that are its own: names and types."""


class RayLoss(NamedTuple):
    """A loss over a ray's samples: a function of their weights, of where they lie, of the light
    that passes them all, and of raw densities.

    Its derivative needs of the rest of the ray what ``State`` holds after all samples.
    """

    Params: Any
    """Struct of numbers that are known when kernels run: factors, units."""
    State: Any
    """Struct of sums over the samples so far, zeros before the first."""
    add: Any
    """(params, state, weight, t, dt, raw_density) -> state with one more sample."""
    value: Any
    """(params, state, transmittance) -> the loss, from all samples and the light that passes."""
    weighted: Any
    """(params, state) -> sum over all samples of weight times dL/dweight."""
    adj_weight: Any
    """(params, total, before, weight, t, dt) -> dL/dweight, from all samples and those before."""
    bound: Any
    """(params, total, t_end) -> no |dL/dweight| exceeds it."""
    adj_transmittance: Any = None
    """(params, transmittance) -> dL/dtransmittance of what passes all samples; None: 0."""
    adj_density: Any = None
    """(params, t) -> dL/draw density of a sample, besides what its weight hands on; None: 0."""
    vectors: RayLossVectors | None = None
    """The vector form. Without one, packs call the scalar functions, one sample after the other."""

    def but(self, **changes: Any) -> "RayLoss":
        """The same with other functions; see above."""
        return self._replace(**{"vectors": None, **changes})


class Photometric(NamedTuple):
    """What a rendered ray's colour is held against its pixel by."""

    Params: Any
    """Struct of numbers that are known when kernels run."""
    value: Any
    """(params, rgb, target_rgb) -> the loss."""
    adj_value: Any
    """(params, rgb, target_rgb, adj_value) -> what flows back to rgb."""


class Losses(NamedTuple):
    """What a training launch minimises: the mean over rays of the sum of these."""

    photometric: Photometric
    """Of the ray's colour."""
    on_ray: RayLoss
    """Of its samples' weights; several are one by ``volume.ray_loss.sum_of``."""
    on_samples: bool = False
    """Whether colours of single samples are held against the pixel as well: volume.sample_loss.
    For heads of samples, whose channels are colours."""
