"""Mutants of the measures that take longer."""

from mutant import of_host

TESTS = "evaluation/test_measures.py::"
SUM = f"{TESTS}test_shares_of_light_are_those_of_the_integral_and_sum_to_one"
COUNTED = f"{TESTS}test_only_pixels_that_count_and_have_a_depth_are_looked_along"
HIDES = f"{TESTS}test_a_wall_hides_what_is_behind_it"
SEEN = f"{TESTS}test_figures_are_of_the_pixels_that_enough_views_see"
BY_HAND = f"{TESTS}test_depth_errors_by_hand"
NEAREST = f"{TESTS}test_the_angle_is_that_to_the_nearest_camera"
WITHOUT = f"{TESTS}test_a_capture_without_depths_is_measured_as_far_as_it_can_be"

LIGHT, SIGHT, MEASURES = (f"evaluation/{name}.py" for name in ("light", "sight", "measures"))

MUTANTS = [
    of_host("light: front up to the surface", LIGHT, "FRONT, BEHIND = 0.8, 1.25", "FRONT, BEHIND = 1.0, 1.25", SUM),
    of_host("light: behind from the surface on", LIGHT, "FRONT, BEHIND = 0.8, 1.25", "FRONT, BEHIND = 0.8, 1.0", SUM),
    of_host("light: shares of what is left", LIGHT, "shares.append(light * opacity)", "shares.append(opacity)", SUM),
    of_host("light: that ends early", LIGHT, "field.up_to(math.inf)", "field", SUM),
    of_host("light: parts that overlap", LIGHT, "limits[:, 1:3]", "limits[:, [0, 2]]", SUM),
    of_host("light: pixels without depth", LIGHT, "np.isfinite(view.depth) & (view.depth > 0.0)", "view.depth > 0.0", COUNTED),
    of_host("light: pixels that do not count", LIGHT, "known &= view.mask", "pass", COUNTED),
    of_host("sight: nothing hides", SIGHT, "found = depths >= (1.0 - TOLERANCE) * distances", "found = depths >= 0.0", HIDES),
    of_host("sight: pixels that do not count", SIGHT, "found &= view.mask[rows, columns]", "pass", HIDES),
    of_host("sight: upside down", SIGHT, "-x / z, y / z", "-x / z, -y / z", HIDES),
    of_host("sight: test views see as well", SIGHT, 'for index in scene.splits["train"]:', "for index in range(len(scene.views)):",
            HIDES),
    of_host("measures: one view more", MEASURES, "counts >= least", "counts > least", SEEN),
    of_host("measures: of all pixels", MEASURES, "psnr(rgb, target, mask)", "psnr(rgb, target, known)", SEEN),
    of_host("measures: coverage of all that is there", MEASURES, "rendering.opacity[mask] >= 0.5", "rendering.opacity[mask] > 0.0",
            SEEN),
    of_host("measures: error by the rendered depth", MEASURES, "error / truth", "error / np.maximum(depth, nearest)", BY_HAND),
    of_host("measures: inverse of nothing", MEASURES, "np.maximum(depth, nearest) - 1.0 / truth", "np.maximum(depth, 1e-9) - 1.0 / truth",
            BY_HAND),
    of_host("measures: the farthest camera", MEASURES, "cosines.max()", "cosines.min()", NEAREST),
    of_host("measures: sum over rays", MEASURES, "[mass / n for mass, n", "[mass for mass, n", WITHOUT),
]  # fmt: skip
