"""Mutants of losses besides the squared error, in both forms."""

from mutant import Mutant

_TESTS = "kernels/test_losses.py"
_F64 = f"{_TESTS}::test_values_and_gradients_against_autograd"
HUBER, DISTORTION, ENTROPY = f"{_F64}[huber]", f"{_F64}[distortion]", f"{_F64}[entropy]"
OPACITY = f"{_F64}[opacity]"
COLOUR, NEAR_CLIP, ALL = f"{_F64}[sample_colour]", f"{_F64}[near_clip]", f"{_F64}[all]"
_PACKS = f"{_TESTS}::test_packs"
P_DISTORTION, P_ENTROPY = f"{_PACKS}[distortion]", f"{_PACKS}[entropy]"
P_COLOUR, P_NEAR_CLIP = f"{_PACKS}[sample_colour]", f"{_PACKS}[near_clip]"
P_FEATURES = f"{_TESTS}::test_packs_of_each_head_of_samples[per_sample-4-32-2-12-True]"
MLP = f"{_TESTS}::test_colours_of_samples_with_an_mlp"
SCALING = f"{_TESTS}::test_the_scaling_multiplies_each_once[float64]"
P_SCALING = f"{_TESTS}::test_the_scaling_multiplies_each_once[packed]"
LIGHT = f"{_TESTS}::test_light_that_is_all_there_or_gone_has_no_entropy"
OWN = f"{_TESTS}::test_losses_with_a_models_own"
ALONE = f"{_TESTS}::test_distortion_where_colours_are_right"
BOTH = "kernels/test_seams.py::test_gradient_against_central_differences[two losses]"
SEAM = "kernels/test_seams.py::test_gradient_on_the_cpu[two losses]"

END = f"{_TESTS}::test_a_ray_that_meets_hardly_anything_has_a_slope_that_ends"
LANES = "kernels/test_seams.py::test_gradient_on_the_cpu[loss on samples]"
LANES_MLP = "kernels/test_seams.py::test_loss_on_samples_that_an_mlp_colours"
D, E, OP, N, C = (
    f"volume/losses/{name}.py"
    for name in ("distortion", "entropy", "opacity", "near_clip", "sample_colour")
)

MUTANTS = [
    # loss.py
    Mutant("huber: the line too flat", "volume/loss.py",
           "square * (real(2.0) * d - square)", "square * d", HUBER),
    Mutant("huber: slope of one side only", "volume/loss.py",
           "-params.delta, params.delta)", "real(-9.0), params.delta)", HUBER),
    Mutant("huber: factor 2", "volume/loss.py",
           "real(2.0) * adj_value * d", "adj_value * d", HUBER),
    # distortion.py
    Mutant("distortion: no spread", D,
           "state.loss + weight * (spread + apart)", "state.loss + weight * apart", DISTORTION),
    Mutant("distortion: pairs once", D,
           "apart = real(2.0) * (s", "apart = (s", DISTORTION),
    Mutant("distortion: distance as it is", D,
           "return t / (unit + t)", "return t", DISTORTION),
    Mutant("distortion: length at its end", D,
           "(unit + begin) * (unit + end)", "(unit + end) * (unit + end)", DISTORTION),
    Mutant("distortion: own weight twice", D,
           "before.weight + weight - total", "before.weight + real(2.0) * weight - total", DISTORTION),
    Mutant("distortion: sign of moments", D,
           "s * nearer - moments + spread", "s * nearer + moments + spread", DISTORTION),
    Mutant("distortion: of degree one", D,
           "return real(2.0) * params.factor * state.loss", "return params.factor * state.loss",
           DISTORTION),
    Mutant("distortion: too small a bound", D,
           "real(8.0) / real(3.0)", "real(0.01)", ALONE),
    Mutant("distortion, packs: its own weight before it", D,
           "before.weight + SHIFT_LANES_1(weights, zero)", "before.weight + weights", P_DISTORTION),
    Mutant("distortion, packs: moments of this pack only", D,
           "before.moment + SHIFT_LANES_1(moments, zero)", "SHIFT_LANES_1(moments, zero)", P_DISTORTION),
    Mutant("distortion, packs: weights are not carried on", D,
           "pack.distortion.c[1] = before.weight + weights", "pack.distortion.c[1] = weights",
           P_DISTORTION),
    Mutant("distortion, packs: slope without the total", D,
           "2.0f * W + weight - total.weight", "2.0f * W + weight", P_DISTORTION),
    Mutant("distortion, packs: factor of the slope", D,
           "(2.0f * params.factor * adj_value)", "(2.0f * adj_value)", P_DISTORTION),
    Mutant("distortion, packs: replaces other slopes", D,
           "load(pack.adj_weight) + slope", "slope", OWN),
    Mutant("distortion, packs: loss of the last pack", D,
           "before.loss + sum(weight", "sum(weight", P_DISTORTION),
    # entropy.py
    Mutant("entropy: half of it", E,
           "p * wp.log(p) + (real(1.0) - p) * wp.log(real(1.0) - p)", "p * wp.log(p)", ENTROPY),
    Mutant("entropy: sign of the slope", E,
           "wp.log(real(1.0) - transmittance) - wp.log(transmittance)",
           "wp.log(transmittance) - wp.log(real(1.0) - transmittance)", ENTROPY),
    Mutant("entropy: no end of the slope", E,
           "transmittance <= real(LEAST) or transmittance >= real(MOST)",
           "transmittance < real(-1.0)", LIGHT),
    Mutant("entropy: not in the adjoint", "volume/walk.py",
           "adj_end += adj.loss * adj_light(on_ray, total.transmittance)",
           "adj_end += real(0.0)", ENTROPY),
    Mutant("entropy, packs: of one ray's weight", "volume/walk_packs.py",
           "adj_end += adj.loss * adj_light(", "adj_end += adj_light(", P_ENTROPY),
    # opacity.py
    Mutant("opacity: sign of the slope", OP,
           "return params.factor / wp.max(", "return -params.factor / wp.max(", OPACITY),
    Mutant("opacity: slope without its weight", OP,
           "return params.factor / wp.max(", "return real(1.0) / wp.max(", OPACITY),
    Mutant("opacity: slope of the light", OP,
           "/ wp.max(real(1.0) - transmittance", "/ wp.max(transmittance", OPACITY),
    Mutant("opacity: no end of the slope", OP,
           "/ wp.max(real(1.0) - transmittance, real(LEAST))", "/ (real(1.0) - transmittance)", END),
    Mutant("opacity: value without the tangent", OP,
           "(most - opacity) / most - wp.log(most)", "real(0.0) - wp.log(most)", END),
    # near_clip.py
    Mutant("near clip: beyond the distance", N,
           "    if t < params.distance:\n        return params.factor",
           "    if t > params.distance:\n        return params.factor", NEAR_CLIP),
    Mutant("near clip: value of all samples", N,
           "    if t < params.distance:\n        out.raw_density += raw_density",
           "    out.raw_density += raw_density", NEAR_CLIP),
    Mutant("near clip: not scaled", "volume/walk.py",
           "scale * (adj.loss * adj_density(", "(adj.loss * adj_density(", NEAR_CLIP),
    Mutant("near clip, packs: not scaled", "volume/pack.py",
           "+ load(pack.scale) * load(pack.adj_density)", "+ load(pack.adj_density)", P_SCALING),
    Mutant("near clip, packs: without its weight", N,
           "splat(params.factor * adj_value)", "splat(adj_value)", P_NEAR_CLIP),
    Mutant("near clip, packs: sum of the last pack", N,
           "before.raw_density + sum(", "sum(", P_NEAR_CLIP),
    # sample_colour.py, sample_loss.py, and where they are called
    Mutant("samples: factor of the slope", C,
           "slope = real(2.0) * params.factor", "slope = params.factor", COLOUR),
    Mutant("samples: sign", C,
           "slope * (rgb - target_rgb)", "slope * (target_rgb - rgb)", COLOUR),
    Mutant("samples: crossed once", C,
           "real(2.0) * wp.dot(rgb", "wp.dot(rgb", COLOUR),
    Mutant("samples: not of the target", C,
           "state.weight * wp.length_sq(target_rgb)", "state.weight", COLOUR),
    Mutant("samples: those without a colour count", "volume/walk.py",
           "if weight > real(weight_min):", "if weight > real(0.0):", MLP, 1, 2),
    Mutant("samples: the ray's slope alone", "volume/walk.py",
           "adj_own += adj_sample(scene.loss.on_samples, channels, target_rgb, adj.loss)",
           "adj_own += real(0.0) * channels", COLOUR),
    Mutant("samples, packs: weights without a colour count", "volume/pack.py",
           "weight > WEIGHT_MIN ? weight : splat(0.0f)", "weight", P_FEATURES),
    Mutant("samples, packs: no target", C,
           "load(pack.channel.data[c]) - target_rgb.c[c]", "load(pack.channel.data[c])", P_COLOUR),
    Mutant("samples, packs: slope of another weight", C,
           "slope = 2.0f * params.factor * adj_value", "slope = params.factor * adj_value", P_COLOUR),
    Mutant("samples, packs: squares of the last pack", C,
           "state.square + packs", "packs", P_COLOUR),
    Mutant("samples, packs: the ray's slope forgotten", C,
           "load(pack.adj_channel.data[c]) + slope * off", "slope * off", P_COLOUR),
    Mutant("samples, packs: what flows back to the ray", "heads/rgb.py",
           "OF_SAMPLE if by_sample else OF_RAY", "OF_RAY", P_COLOUR),
    Mutant("samples, by lanes: all have a colour", "volume/sample_loss.py",
           "packs[slot].colour_weight[lane]", "packs[slot].weight[lane]", LANES_MLP),
    Mutant("samples, by lanes: the last channel's", "volume/sample_loss.py",
           "adj[c, lane] = own[c]", "adj[c, lane] = own[n_channels - 1]", LANES),
    Mutant("samples, by lanes: without the ray's", "volume/sample_loss.py",
           "packs[slot].adj_channel + adj", "adj", LANES),
    Mutant("samples, by lanes: sums of one sample", "volume/sample_loss.py",
           "after = add(params, after, weight", "after = add(params, state, weight", LANES),
    # ray_loss.py: any loss, and two as one
    Mutant("loss: of lanes that are no samples", "volume/ray_loss.py",
           "            if packs[slot].active[lane] != 0:\n", "            if packs[slot].active[lane] == 0:\n",
           SEAM, 1, 2),
    Mutant("loss: sums do not grow", "volume/ray_loss.py",
           "after = add(params, after, weight, t, dt, packs[slot].raw[0, lane])", "after = state", SEAM, 1, 2),
    Mutant("loss: its factor", "volume/ray_loss.py",
           "adj[lane] = adj_value * adj_weight(", "adj[lane] = adj_weight(", SEAM),
    Mutant("loss: not behind", "volume/walk_packs.py",
           "            suffix_sum += adj.loss * weighted(on_ray, rows[row].loss)\n", "", SEAM),
    Mutant("loss: no slope", "volume/pack.py",
           "adj_weight += load(pack.adj_weight);", "", SEAM),
    Mutant("two losses: light of the first only", "volume/ray_loss.py",
           " + adj_light_b(params.b, transmittance)", "", ALL),
    Mutant("two losses: densities of the first only", "volume/ray_loss.py",
           " + adj_density_b(params.b, t)", "", ALL),
    Mutant("two losses: one's numbers for both", "volume/ray_loss.py",
           "weighted_a(params.a, state.a) + weighted_b(params.b, state.b)",
           "weighted_a(params.a, state.a)", BOTH),
]  # fmt: skip
