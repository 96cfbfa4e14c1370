"""Interfaces of a model's kernels, space, sampler, encoding, head and losses, which
``launch.assembly`` puts together.

Each part has a scalar form, which runs on CUDA, in float64 and wherever a vector form is missing,
and may have a vector form for the CPU: sixteen samples, or the rows of a batch, at a time. Adjoints
stand directly below. Parts are values that Python can hash, so that kernels made of them are kept.
A part that differs from another in some functions is ``other.replace(name=function)``: it has no
vector form, unless it is given one too, since that of the other would not do the same.

Names of arguments in the signatures below:

    params      what the part reads, a Warp struct of its own
    q, c        normalised and contracted coordinates, see base.types
    position    of a sample, contracted coordinates c
    raw         what a field holds at a sample, ``vector(n_floats)``: raw density first
    channels    what is accumulated along a ray, ``vector(n_channels)``
    gradient    the encoding's ``Gradient``: added to
    packs, slot scratch of a CPU worker: sixteen steps, see volume.pack
    rows, row   scratch of a CPU worker: what belongs to a ray, see volume.walk_packs
"""

from typing import Any, NamedTuple


class SpaceVectors(NamedTuple):
    """The SIMD form of a space: C++ statements on sixteen steps, with the functions of base.simd.

    sampling.traversal puts them into functions of its own, in which ``box`` and ``ray`` are known.
    """

    locate: str
    """Of contract and det_jacobian: changes qx, qy, qz to c, and det_jacobian, which is 1; takes
    the lanes out of ``active`` that lie outside."""
    distance: str = ""
    """Of distance_of and ends: changes t, and takes lanes out of ``active``."""
    length: str = ""
    """Of length_of: changes ``length``, the pack's dt, where its t are distances."""


class Space(NamedTuple):
    """Space contraction: in which coordinates rays are straight, and what of space outside the box
    becomes.

    Steps are placed on q(t) = ray.q_origin + t ray.q_direction, with the box at [-1, 1]^3.
    """

    contracts: bool
    """Whether all space outside the box is contracted into a shell around it. If not, nothing is
    sampled outside, and c is q."""
    enter: Any
    """(box, ray, origin, interval of t) -> the ray, which has its direction, with q_origin and
    q_direction; what of the interval may hold samples."""
    contract: Any
    """(box, q) -> c."""
    det_jacobian: Any
    """(box, q) -> |det dc/dq|."""
    boxes_out: Any
    """(box, c) -> how many half boxes from the middle a place is: 0 in the box, and where c is that
    of infinity, INFINITELY_FAR."""
    distance_of: Any
    """(ray, t) -> how far from its origin a ray is at t, scene units."""
    length_of: Any
    """(ray, distance, dt) -> how long a step dt at a distance is, scene units."""
    ends: Any
    """(box, distance) -> whether nothing is sampled at a distance and beyond it."""
    stretch: float = 1.0
    """contract makes no displacement longer than this: largest component out, length in."""
    vectors: SpaceVectors | None = None
    """The vector form, if it has one."""

    def replace(self, **changes: Any) -> "Space":
        """A copy with some functions replaced; see above."""
        return self._replace(**{"vectors": None, **changes})


INFINITELY_FAR = 1.0e30
"""In half boxes."""


class Sampler(NamedTuple):
    """Ray sampling: where the steps of a ray lie."""

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
    """(params, boxes_out) -> the longest step whose sample can lie at most so many half boxes from
    the middle, as Space.boxes_out says: cells that are free have to be so for it."""
    keep: Any = None
    """(params, ray, step, weight) is told what each sample weighs, when a ray is composited; None:
    nobody asks."""
    place_pack: Any = None
    """Vector form of interval: (params, ray, step, packs, slot) places sixteen steps."""
    keep_pack: Any = None
    """Vector form of keep: (params, ray, packs, slot)."""

    def replace(self, **changes: Any) -> "Sampler":
        """A copy with some functions replaced; see above."""
        return self._replace(**{"place_pack": None, "keep_pack": None, **changes})


class EncodingVectors(NamedTuple):
    """The SIMD form of an encoding."""

    read_pack: Any
    """Of read: (params, ray, packs, slot), from x, y, z of a pack to its raw."""
    adj_read_pack: Any
    """Of adj_read: (params, packs, slot, later, worker, sink) adds a pack's adj_raw where the
    worker owns what it was read from, and leaves a record of the rest."""
    prefetch_gradient: Any
    """(params, packs, slot, worker, sink) prefetches the memory that adj_read_pack will change, of
    a ray's first packs; adj_read_pack prefetches that of later ones."""
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
    record_bytes: int | None = None
    """What a record counts for where there is room for so many; None: all that it takes."""
    begin: Any = None
    """(params, worker) before a worker's first ray of a launch that ends in a gradient, such as to
    lay out a decoder again; None: nothing."""


class Encoding(NamedTuple):
    """The encoding of a field: what is stored over space, how it is interpolated, its adjoint."""

    n_floats: int
    """Numbers read at a position: raw density, features, and padding that nothing looks at."""
    Params: Any
    """Struct of the stored values, in as many arrays as there are."""
    Gradient: Any
    """Struct of their gradient: what ``adj_read`` adds to, and ``weights``, [n_workers, n] with a
    copy for each worker, which a head's adjoints add to. ``base.types.gradient_type`` where all is
    in one array."""
    read: Any
    """(params, position) -> raw."""
    adj_read: Any
    """(params, position, adj_raw, gradient) scatters adj_raw to what raw was interpolated from."""
    place: Any
    """(params, position) -> where it lies in the field, [0, 1]^3; workers own parts along the first
    axis, and take rays by it."""
    vectors: EncodingVectors | None = None
    """The vector form, if it has one."""

    def replace(self, **changes: Any) -> "Encoding":
        """A copy with some functions replaced; see above."""
        return self._replace(**{"vectors": None, **changes})


class HeadVectors(NamedTuple):
    """The SIMD form of a head."""

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
    """(by_sample) -> of adj_decode: (params, rows, row, packs, slot, n, worker, gradient) from
    weight, scale and what flows back to channels to adj_raw, but for the density's. What flows
    back is the row's adj.channels or, ``by_sample``, the pack's adj_channel, each sample's own.
    ``heads.rgb.decoding`` makes it of C++."""
    shade_rows: Any
    """Of shade: (params, rows, row, n) for n rays, from channels and transmittance to rgb."""
    adj_shade_rows: Any
    """Of adj_shade: (params, rows, row, n, worker, gradient) from adj_rgb to adj.channels and
    adj_opacity."""
    pack_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a pack that are its own: names and types."""
    row_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a row that are its own."""
    n_packs: int = 1
    """Packs of a ray that are decoded together, at most."""
    batch: int = 1
    """Rays whose rows are shaded together."""


class Head(NamedTuple):
    """The colour head: from features of samples to channels that are composited along the ray, and
    on to RGB.

    A head of samples decodes each one's features to red, green and blue, and passes their sum on as
    it is. A head of rays accumulates features, and shades each ray once.
    """

    n_channels: int
    """Channels accumulated (alpha-composited) along a ray."""
    Params: Any
    """Struct of what the head reads besides features: the weights of an MLP, or Nothing."""
    ViewFeatures: Any
    """Vector type of what depends on the direction of view, computed once a ray."""
    prepare: Any
    """(params, direction) -> view."""
    adj_prepare: Any
    """(params, direction, adj_view, gradient) once a ray, after its samples."""
    decode: Any
    """(params, view, raw) -> channels of a sample, each of which lies in [0, 1]: what lies behind a
    sample is bounded by that, see volume.walk.suffix_limit."""
    adj_decode: Any
    """(params, view, raw, channels, adj_channels, gradient) -> adj_raw, as long as raw, whose
    first entry, that of the density, is 0, and adj_view, as long as view."""
    shade: Any
    """(params, direction, channels, opacity) -> rgb before the background, once a ray."""
    adj_shade: Any
    """(params, direction, channels, opacity, adj_rgb, gradient) -> adj_channels, adj_opacity."""
    weight_min: float = -1.0
    """Samples of no more weight are not decoded: their channels are 0."""
    vectors: HeadVectors | None = None
    """The vector form, if it has one."""

    def replace(self, **changes: Any) -> "Head":
        """A copy with some functions replaced; see above."""
        return self._replace(**{"vectors": None, **changes})


class RayLossVectors(NamedTuple):
    """The SIMD form of a loss on the ray: sixteen samples at a time. Steps that are no samples
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
    """(params, t) -> dL/draw density of a sample, besides what its weight passes on; None: 0."""
    vectors: RayLossVectors | None = None
    """The vector form. Without one, packs call the scalar functions, one sample after the other."""

    def replace(self, **changes: Any) -> "RayLoss":
        """A copy with some functions replaced; see above."""
        return self._replace(**{"vectors": None, **changes})


class SampleLossVectors(NamedTuple):
    """The SIMD form of a loss on samples: sixteen at a time."""

    add_pack: Any
    """Of add: (params, state, target_rgb, packs, slot) -> state with a pack's samples, whose
    weights are in its colour_weight: 0 where a sample has no colour."""
    adj_add_pack: Any
    """Of adj_channels: (params, adj_value, target_rgb, packs, slot) adds to the pack's adj_channel.
    What it adds for samples that have no colour is not looked at."""
    pack_fields: tuple[tuple[str, Any], ...] = ()
    """Fields of a pack that are its own: names and types."""


class SampleLoss(NamedTuple):
    """A loss over the colours of a ray's samples, each times the sample's weight, which counts as a
    constant: it reaches colours only. For heads of samples, whose channels are colours. Samples
    that have none, as they weigh no more than the head's ``weight_min``, do not count.
    """

    Params: Any
    """Struct of numbers that are known when kernels run."""
    State: Any
    """Struct of sums over the samples so far, zeros before the first."""
    add: Any
    """(params, state, weight, channels, target_rgb) -> state with one more sample."""
    value: Any
    """(params, state, channels, target_rgb) -> the loss, from all samples; here channels are the
    ray's, sums of weight times channel."""
    adj_channels: Any
    """(params, channels, target_rgb, adj_value) -> what flows back to a sample's channels, over its
    weight."""
    vectors: SampleLossVectors | None = None
    """The vector form. Without one, packs call the scalar functions, one sample after the other."""

    def replace(self, **changes: Any) -> "SampleLoss":
        """A copy with some functions replaced; see above."""
        return self._replace(**{"vectors": None, **changes})


class Photometric(NamedTuple):
    """A photometric loss: it compares a rendered ray's colour with its pixel."""

    Params: Any
    """Struct of numbers that are known when kernels run."""
    value: Any
    """(params, rgb, target_rgb) -> the loss."""
    adj_value: Any
    """(params, rgb, target_rgb, adj_value) -> what flows back to rgb."""


class Losses(NamedTuple):
    """The training loss of a launch: the mean over rays of the sum of these."""

    photometric: Photometric
    """Of the ray's colour."""
    on_ray: RayLoss
    """Of its samples' weights; several are one by ``volume.ray_loss.sum_of``."""
    on_samples: SampleLoss
    """Of its samples' colours."""
