"""Configurations to begin with, by name.

``fast`` and ``quality`` are what warpnerf reaches in a minute or three and in a quarter of an hour
on two cores; docs/decisions/presets.md says how they were chosen. The others are there to compare
with, and take up to hours on two cores: the published hyperparameters of DirectVoxGO, TensoRF and
Instant-NGP, and ``mip360``, which samples as Mip-NeRF 360 does. They take photographs as they are.

``dvgo``, ``dvgo-unbounded`` and ``dvgo-llff`` are DirectVoxGO's: Sun et al. 2022 (CVPR), Sun et
al. 2022 (arXiv 2206.05085), and default.py, nerf_unbounded_default.py and llff_default.py in their
repository. Different here:

- Gradients are scaled by distance; ``scaling="none"`` leaves that out.
- The near plane is 0; theirs is 2 in Blender's scenes.
- In dvgo a coarse stage gives free space and a box 5 % larger on each axis than what it finds; here
  the grid's own first steps do. So that space that no camera sees is free, densities begin with an
  opacity of 1e-4 and count as free below 1e-3; theirs begin with 1e-2, and are free below 1e-4.
- In dvgo-unbounded their box is a cube that holds all cameras' rays at the near clip; here it is
  0.75 content distances to each side.
- Outside the box their samples are thinned to 0.95 of a step in contracted space; here steps grow.
- Their free space only ever grows; here it is recomputed.
- Rays that meet free space only are left out; there they are replaced by others.
- The opacity below which space is free rises there in the first 5500 steps of dvgo-unbounded.
- Total variation reaches the nodes that rays have touched; theirs reaches all of them, in
  dvgo-unbounded always and in dvgo-llff in the first 10 000 steps.
- Their planes are 128 from the start; here coarser grids have fewer.
- Their squared error is the mean over red, green and blue, here it is the sum: weights of other
  losses are three times theirs.
- Their total variation has the weight w / rays * longest axis / 128 / 6 for each pair of nodes; it
  is given here as it is for the final grid.
- Their near clip needs a distance for each scene; the distance scaling takes its place.
- Their planes in normalised device coordinates begin with a density each; here all begin with one.

``tensorf`` is TensoRF's VM-192 for objects: Chen et al. 2022 (ECCV), configs/lego.txt in their
repository. Different here:

- The near plane is 0 and gradients are scaled by distance, as above.
- One matrix decodes all products, to density and to features; theirs adds 48 products up to the
  density, and decodes the other 144. Features are not encoded by sines before the MLP.
- Density is softplus over a voxel of the final lattice; theirs over a 25th of a scene unit.
- Grids before the last have half the nodes of the next, and the first 119^3; theirs grow from
  128^3 in five equal ratios.
- L1 has the lower of their two weights, reaches entries that rays have touched, and is added to
  each eighth update, which counts eight times. The weight is three times theirs, as the squared
  error is.
- Free space is looked for each 1000 steps, not twice, and the box becomes tight at each growth.

``ngp`` is Instant-NGP for objects: Mueller et al. 2022 (SIGGRAPH), configs/nerf/base.json as first
published in their repository, and scripts/run.py. Different here:

- The near plane is 0 and gradients are scaled by distance, as above; they push densities near
  cameras down instead.
- Where a level has more nodes than entries, rows of nodes along z are hashed as wholes; theirs
  hashes single nodes. Level l has 16 * 128^(l / 15) cells, rounded, along the longest edge of the
  scene's box; theirs over a cube, one fewer, with nodes half a cell off the faces.
- Density is softplus over a voxel of the lattice, 128 along an edge as their occupancy grid; theirs
  is an exponential.
- A step draws 4096 rays, as theirs does at first; theirs then draws as many as have 2^18 samples.
- The colour network sees the other 15 outputs and four octaves of the direction, and has biases;
  theirs sees all 16 outputs and spherical harmonics of degree 4, and has none. Here samples of no
  more weight than 1e-4 get no colour.
- Learning rates fall from the start on, to what theirs are at the end; theirs fall at 20 000 and
  30 000 steps. The networks' weights do not decay, and those that render are the last ones, not
  their running mean.
- Free space is looked for each 100 steps at all nodes, by the densities there; theirs by samples
  in cells with a decaying maximum, each 16 steps or oftener.

``mip360`` has of Mip-NeRF 360 what does not need its network: Barron et al. 2022 (CVPR), and
360.gin in google-research/multinerf. Space is contracted by the Euclidean norm, to twice the box;
samples are drawn from proposals, uniform in s = t / (D + t) from the camera on; the distortion loss
is of s; an MLP colours each sample. Different here:

- A hash stands for their network of 8 layers of 1024 units, which took 17 million operations a
  sample, and a grid of densities for the network of proposals. Samples are points, not cones.
- One proposal of 64 bins; theirs are two.
- 25 000 steps of 4096 rays; theirs are 250 000 of 16 384, at the rates of their network.
- Huber's loss stands for Charbonnier's; gradients are not clipped, but scaled by distance.
- A loss on opacity is added.
- The near plane is 0; theirs is 0.2. The colour network has two layers of 64 units.
- D is the content distance; they scale scenes so that all cameras lie in a cube of edge 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from warpnerf.config import GridConfig, LossConfig, MarchConfig, TrainConfig
from warpnerf.model.models import PerSample
from warpnerf.model.sampler_kinds import MARCHED, Resampled
from warpnerf.model.storage_kinds import AUTO_FIELD, Hash, Vm
from warpnerf.optim_config import OptimConfig

_FAST = TrainConfig()

_DVGO = TrainConfig(
    appearance="none",
    average_pixels=False,
    settle_at=None,
    sampler=MARCHED,
    steps=20_000,
    rays_per_step=8192,
    coarse_steps=0,
    occupancy_every=1000,
    alpha_min=1e-4,
    model=PerSample(width=128, residual=False, learning_rate_features=0.1, learning_rate_mlp=1e-3),
    grid=GridConfig(
        voxels=160**3,
        grow_at=(0.05, 0.1, 0.15, 0.2),
        shift_at_growth=1.0,
        alpha_init=1e-4,
    ),
    march=MarchConfig(step_voxels=0.5, jitter=False),
    optim=OptimConfig(
        learning_rate_density=0.1,
        learning_rate_rgb=0.1,
        decay=0.1,
        restart_at_growth=True,
        tv_density=0.0,
        tv_rgb=0.0,
        accumulate_at=(),
    ),
    loss=LossConfig(entropy=3e-3, sample_colour=3e-2),
)

_PRESETS = {
    "fast": _FAST,
    "quality": replace(
        _FAST,
        steps=200_000,
        time_limit=900.0,
        field=AUTO_FIELD,
        grid=GridConfig(voxels="auto"),
        optim=OptimConfig(decay=0.03),
    ),
    "dvgo": replace(_DVGO, alpha_min=1e-3),
    "dvgo-unbounded": replace(
        _DVGO,
        steps=40_000,
        rays_per_step=4096,
        background="random",
        grid=GridConfig(
            voxels=320**3,
            grow_at=(0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4),
            shift_at_growth=1.0,
            alpha_init=1e-4,
            contraction="linf",
            box="scene",
            border=0.2,
        ),
        march=replace(_DVGO.march, growth=0.1),
        optim=replace(
            _DVGO.optim,
            decay=0.1**0.5,
            tv_density=3e-10,
            tv_rgb=3e-11,
            tv_until=0.5,
            tv_every=1,
        ),
        loss=LossConfig(distortion=3e-2, entropy=3e-3, sample_colour=3e-2),
    ),
    "dvgo-llff": replace(
        _DVGO,
        steps=30_000,
        rays_per_step=4096,
        alpha_min=1e-3,
        model=PerSample(
            features=9,
            frequencies=0,
            width=64,
            residual=False,
            threshold=1e-3,
            learning_rate_features=0.1,
            learning_rate_mlp=1e-3,
        ),
        grid=GridConfig(
            voxels=256**3,
            planes=128,
            grow_at=(1 / 15, 2 / 15, 3 / 15, 4 / 15),
            shift_at_growth=1.0,
            alpha_init=1 / 128,
            contraction="ndc",
        ),
        optim=replace(_DVGO.optim, decay=0.1**1.5, tv_density=4e-9, tv_rgb=4e-10, tv_every=1),
        loss=LossConfig(distortion=3e-2, entropy=3e-3, sample_colour=3e-2),
    ),
    "tensorf": replace(
        _DVGO,
        steps=30_000,
        rays_per_step=4096,
        model=PerSample(
            features=27, frequencies=2, width=128, residual=False, learning_rate_mlp=1e-3
        ),
        field=Vm(
            density=16,
            appearance=48,
            learning_rate=0.02,
            learning_rate_decoder=1e-3,
            sparsity=1.2e-4,
        ),
        grid=GridConfig(
            voxels=300**3,
            grow_at=(2000 / 30_000, 3000 / 30_000, 4000 / 30_000, 7000 / 30_000),
            alpha_init=1e-5,
        ),
        march=MarchConfig(step_voxels=0.5),
        optim=OptimConfig(
            decay=0.1, restart_at_growth=True, tv_density=0.0, tv_rgb=0.0, accumulate_at=()
        ),
        loss=LossConfig(),
    ),
    "ngp": TrainConfig(
        appearance="none",
        average_pixels=False,
        settle_at=None,
        sampler=MARCHED,
        steps=35_000,
        background="random",
        coarse_steps=0,
        alpha_min=0.01,
        model=PerSample(
            features=15, frequencies=4, width=64, residual=False, learning_rate_mlp=0.01
        ),
        field=Hash(
            levels=16,
            features=2,
            coarsest=16,
            finest=2048,
            table=1 << 19,
            hidden=64,
            learning_rate=0.01,
            learning_rate_decoder=0.01,
            epsilon=1e-15,
        ),
        grid=GridConfig(voxels=128**3, grow_at=(), alpha_init=1 / 128),
        march=MarchConfig(step_voxels=127 * 3**0.5 / 1024, transmittance_min=1e-4),
        optim=OptimConfig(decay=0.33**2, epsilon=1e-15, accumulate_at=()),
        loss=LossConfig(photometric="huber"),
    ),
    "mip360": TrainConfig(
        appearance="none",
        average_pixels=False,
        settle_at=None,
        steps=25_000,
        model=PerSample(
            features=15, width=64, hidden_layers=2, residual=False, learning_rate_mlp=2e-3
        ),
        field=Hash(table=1 << 19),
        sampler=Resampled(),
        grid=GridConfig(contraction="l2", border=1.0),
        optim=OptimConfig(decay=0.01, beta2=0.999),
        loss=LossConfig(photometric="huber", distortion=0.03, opacity="auto"),
    ),
}

PRESETS: Mapping[str, TrainConfig] = MappingProxyType(_PRESETS)
"""By name; change one with ``dataclasses.replace``."""

DEFAULT_PRESETS = ("fast", "quality")
"""Those that every command knows the cost of, and that ``warmup`` compiles for."""
