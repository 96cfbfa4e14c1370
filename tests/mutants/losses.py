"""Mutants of losses besides the squared error, in both forms."""

from mutant import Mutant

_TESTS = "test_losses.py"
_F64 = f"{_TESTS}::test_values_and_gradients_against_autograd"
HUBER, DISTORTION, ENTROPY = f"{_F64}[huber]", f"{_F64}[distortion]", f"{_F64}[entropy]"
OPACITY = f"{_F64}[opacity]"
COLOUR, NEAR_CLIP, ALL = f"{_F64}[sample_colour]", f"{_F64}[near_clip]", f"{_F64}[all]"
_PACKS = f"{_TESTS}::test_packs"
P_DISTORTION, P_ENTROPY = f"{_PACKS}[distortion]", f"{_PACKS}[entropy]"
P_COLOUR, P_NEAR_CLIP = f"{_PACKS}[sample_colour]", f"{_PACKS}[near_clip]"
P_FEATURES = f"{_TESTS}::test_packs_of_each_head_of_samples[features-4-32-2-12-True]"
MLP = f"{_TESTS}::test_colours_of_samples_with_an_mlp"
SCALING = f"{_TESTS}::test_the_scaling_multiplies_each_once[float64]"
P_SCALING = f"{_TESTS}::test_the_scaling_multiplies_each_once[packed]"
LIGHT = f"{_TESTS}::test_light_that_is_all_there_or_gone_has_no_entropy"
OWN = f"{_TESTS}::test_losses_with_a_models_own"
ALONE = f"{_TESTS}::test_distortion_where_colours_are_right"
BOTH = "test_seams.py::test_gradient_against_central_differences[two losses]"
SEAM = "test_seams.py::test_gradient_on_the_cpu[two losses]"

END = f"{_TESTS}::test_a_ray_that_meets_hardly_anything_has_a_slope_that_ends"
D, E, OP, N = (
    f"volume/losses/{name}.py" for name in ("distortion", "entropy", "opacity", "near_clip")
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
           "before.weight + UP_1(weights, zero)", "before.weight + weights", P_DISTORTION),
    Mutant("distortion, packs: moments of this pack only", D,
           "before.moment + UP_1(moments, zero)", "UP_1(moments, zero)", P_DISTORTION),
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
           "adj_end += adj_loss_value * adj_light(on_ray, total.transmittance)",
           "adj_end += real(0.0)", ENTROPY),
    Mutant("entropy, packs: of one ray's weight", "volume/walk_packs.py",
           "adj_end += adj_loss_value * adj_light(", "adj_end += adj_light(", P_ENTROPY),
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
           "scale * (adj_loss_value * adj_density(", "(adj_loss_value * adj_density(", NEAR_CLIP),
    Mutant("near clip, packs: not scaled", "volume/pack.py",
           "+ load(pack.scale) * load(pack.adj_density)", "+ load(pack.adj_density)", P_SCALING),
    Mutant("near clip, packs: without its weight", N,
           "all(params.factor * adj_value)", "all(adj_value)", P_NEAR_CLIP),
    Mutant("near clip, packs: sum of the last pack", N,
           "before.raw_density + sum(", "sum(", P_NEAR_CLIP),
    # sample_loss.py, and where it is called
    Mutant("samples: factor of the slope", "volume/walk.py",
           "slope = real(2.0) * scene.loss.on_samples", "slope = scene.loss.on_samples", COLOUR),
    Mutant("samples: sign", "volume/sample_loss.py",
           "slope * (rgb - target_rgb)", "slope * (target_rgb - rgb)", COLOUR),
    Mutant("samples: crossed once", "volume/sample_loss.py",
           "real(2.0) * wp.dot(rgb", "wp.dot(rgb", COLOUR),
    Mutant("samples: not of the target", "volume/sample_loss.py",
           "sums.weight * wp.length_sq(target_rgb)", "sums.weight", COLOUR),
    Mutant("samples: opacity for weights with a colour", "volume/walk.py",
           "                        total.of_samples.weight += weight\n",
           "                        total.of_samples.weight = real(1.0) - total.transmittance\n", MLP),
    Mutant("samples, packs: weights without a colour count", "volume/pack.py",
           "weight > WEIGHT_MIN ? weight : all(0.0f)", "weight", P_FEATURES),
    Mutant("samples, packs: no target", "heads/rgb.py",
           "(channel - rows.data[row].target_rgb.c[c])", "channel", P_COLOUR),
    Mutant("samples, packs: slope of another weight", "volume/walk_packs.py",
           "2.0 * scene.loss.on_samples * adj_loss_value", "scene.loss.on_samples * adj_loss_value",
           P_COLOUR),
    Mutant("samples, packs: squares of the last pack", "volume/walk_packs.py",
           "of_samples.square += packs", "of_samples.square = packs", P_COLOUR),
    # ray_loss.py: any loss, and two as one
    Mutant("loss: of lanes that are no samples", "volume/ray_loss.py",
           "            if packs[slot].visited[lane] != 0:\n", "            if packs[slot].visited[lane] == 0:\n",
           SEAM, 1, 2),
    Mutant("loss: sums do not grow", "volume/ray_loss.py",
           "after = add(params, after, weight, t, dt, packs[slot].raw[0, lane])", "after = state", SEAM, 1, 2),
    Mutant("loss: its factor", "volume/ray_loss.py",
           "adj[lane] = adj_value * adj_weight(", "adj[lane] = adj_weight(", SEAM),
    Mutant("loss: not behind", "volume/walk_packs.py",
           "            behind += adj_loss_value * weighted(on_ray, rows[row].loss)\n", "", SEAM),
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
