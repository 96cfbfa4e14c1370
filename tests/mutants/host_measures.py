"""Mutants of the measures that take longer, and of comparisons of trainings by them."""

from mutant import of_host

TESTS = "evaluation/test_measures.py::"
SUM = f"{TESTS}test_shares_of_light_are_those_of_the_integral_and_sum_to_one"
COUNTED = f"{TESTS}test_only_pixels_that_count_and_have_a_depth_are_looked_along"
HIDES = f"{TESTS}test_a_wall_hides_what_is_behind_it"
SEEN = f"{TESTS}test_figures_are_of_the_pixels_that_enough_views_see"
BY_HAND = f"{TESTS}test_depth_errors_by_hand"
NEAREST = f"{TESTS}test_the_angle_is_that_to_the_nearest_camera"
POINTS = f"{TESTS}test_points_stand_in_where_no_depths_are_known"
WITHOUT = f"{TESTS}test_a_capture_without_depths_is_measured_as_far_as_it_can_be"

LIGHT, SIGHT, MEASURES = (f"evaluation/{name}.py" for name in ("light", "sight", "measures"))

PAIRED = "reports/test_paired.py::"
TABLES = f"{PAIRED}test_quantiles_are_those_of_tables"
SEEDS = f"{PAIRED}test_seeds_are_paired"
COMPARE = "reports/test_compare.py::"
CUT = f"{COMPARE}test_cut_anywhere_it_ends_with_the_same_bits"
FIRST = f"{COMPARE}test_each_is_compared_with_the_first_scaling_of_its_own_kind"
WORDS = f"{COMPARE}test_a_sentence_tells_better_from_worse_and_from_chance"
REFUSED = f"{COMPARE}test_a_folder_of_something_else_is_refused"
REPORT = f"{COMPARE}test_the_report_is_one_file_and_says_what_figures_say"
TABLE = (
    "reports/test_demonstration.py::test_the_table_says_of_each_row_whether_it_is_better_or_why_not"
)
PLAN = (
    "evaluation/test_near_plan.py::test_vertical_lines_through_balls_around_cameras_in_even_density"
)
OVERLAP = "scenes/test_overlap.py::test_overlap_along_rays_of_two_cameras_side_by_side"

FAR_BELOW, FEW_TELL, OPAQUE_COUNT, ARE_SAID = (
    "reports/test_misfits.py::test_those_far_below_the_others_are_found",
    "reports/test_misfits.py::test_few_photographs_do_not_tell",
    "training/test_photograph_errors.py::test_late_rays_of_opaque_pixels_count",
    "cli/test_command.py::test_photographs_that_do_not_fit_are_said",
)
ELSE_TOLD = "training/test_photograph_errors.py::test_a_photograph_of_something_else_is_told"
ERRORS, MISFITS = "training/photograph_errors.py", "reports/misfits.py"
TRAINER = "training/trainer.py"

MUTANTS = [
    of_host("light: front up to the surface", LIGHT, "FRONT, BEHIND = 0.8, 1.25", "FRONT, BEHIND = 1.0, 1.25", SUM),
    of_host("light: behind from the surface on", LIGHT, "FRONT, BEHIND = 0.8, 1.25", "FRONT, BEHIND = 0.8, 1.0", SUM),
    of_host("light: shares of what is left", LIGHT, "shares.append(light * opacity)", "shares.append(opacity)", SUM),
    of_host("light: that ends early", LIGHT, "field.up_to(math.inf)", "field", SUM),
    of_host("light: parts that overlap", LIGHT, "limits[:, 1:3]", "limits[:, [0, 2]]", SUM),
    of_host("light: pixels without depth", LIGHT, "chosen = np.isfinite(depths)", "chosen = ~np.isneginf(depths)", COUNTED),
    of_host("light: pixels that do not count", SIGHT, "depths if view.mask is None else np.where(view.mask, depths, np.nan)",
            "depths", COUNTED),
    of_host("sight: nothing hides", SIGHT, "found = depths >= (1.0 - TOLERANCE) * distances", "found = depths >= 0.0", HIDES),
    of_host("sight: pixels that do not count", SIGHT, "found &= view.mask[rows, columns]", "pass", HIDES),
    of_host("sight: upside down", SIGHT, "-x / z, y / z", "-x / z, -y / z", HIDES),
    of_host("sight: test views see as well", SIGHT, 'for index in scene.splits["train"]:', "for index in range(len(scene.views)):",
            HIDES),
    of_host("sight: counted for each training", SIGHT, "if view.name not in self._counts:", "if True:", CUT),
    of_host("sight: the farthest point of a pixel", SIGHT, "np.argsort(-away", "np.argsort(away", POINTS),
    of_host("sight: test views show points as well", SIGHT,
            '(scene.views[index].name for index in scene.splits["train"])', "(view.name for view in scene.views)",
            POINTS),
    of_host("tracks: a point that is matched twice", "scenes/cameras/tracks.py", "counts[self.of(name)] += 1",
            "np.add.at(counts, self.of(name), 1)", POINTS),
    of_host("measures: one view more", MEASURES, "counts >= least", "counts > least", SEEN),
    of_host("measures: of all pixels", MEASURES, "psnr(rgb, target, mask)", "psnr(rgb, target, known)", SEEN),
    of_host("measures: coverage of all that is there", MEASURES, "rendering.opacity[mask] >= 0.5", "rendering.opacity[mask] > 0.0",
            SEEN),
    of_host("measures: error by the rendered depth", MEASURES, "error / truth", "error / np.maximum(depth, nearest)", BY_HAND),
    of_host("measures: inverse of nothing", MEASURES, "np.maximum(depth, nearest) - 1.0 / truth", "np.maximum(depth, 1e-9) - 1.0 / truth",
            BY_HAND),
    of_host("measures: the farthest camera", MEASURES, "cosines.max()", "cosines.min()", NEAREST),
    of_host("measures: sum over rays", MEASURES, "[mass / n for mass, n", "[mass for mass, n", WITHOUT),
    of_host("paired: one degree of freedom more", "reports/paired.py", "t_quantile(n - 1,", "t_quantile(n,", SEEDS),
    of_host("paired: deviation of all there are", "reports/paired.py", "std(ddof=1)", "std()", SEEDS),
    of_host("paired: one side", "reports/paired.py", "0.5 + CONFIDENCE / 2.0", "CONFIDENCE", SEEDS),
    of_host("paired: terms of the other series", "reports/paired.py", "(k + 1) / (k + 2)", "k / (k + 1)", TABLES),
    of_host("compare: against the first of all", "reports/comparison.py", "if n_forms > 1 else first", "if False else first",
            FIRST),
    of_host("compare: better is more", "reports/comparison.py", "int(np.sign(difference.mean)) * figure.better",
            "int(np.sign(difference.mean))", WORDS),
    of_host("compare: differences the other way", "reports/comparison.py", "paired_difference(mine[name], theirs[name])",
            "paired_difference(theirs[name], mine[name])", REPORT),
    of_host("near plan: radius in place of the chord", "evaluation/near_plan.py", "half = np.sqrt(radius**2 - apart[rows, columns] ** 2)",
            "half = np.full(len(rows), radius)", PLAN),
    of_host("near plan: the last camera", "evaluation/near_plan.py", "np.fmax(depths[rows, columns], found)", "found", PLAN),
    of_host("near plan: parts that begin before the near plane", "evaluation/near_plan.py", "origins[:, up] -= half + near",
            "origins[:, up] -= half", PLAN),
    of_host("film: as far as content", "reports/comparison_film.py", "distance = BACK_SHARE * scene.content_distance",
            "distance = scene.content_distance", REPORT),
    of_host("film: one configuration", "reports/comparison_film.py", "there = [c for c in experiment.candidates if",
            "there = [c for c in experiment.candidates[:1] if", REPORT),
    of_host("demo: better is more", "reports/demonstration.py", "round(better * (values", "round((values", TABLE),
    of_host("compare: cut trainings start again", "reports/experiment.py", "if run.checkpoints:", "if False:", CUT),
    of_host("compare: the seed of the configuration", "reports/experiment.py", "replace(candidate.config, seed=seed)", "candidate.config",
            CUT),
    of_host("compare: what is cut counts as trained", "reports/experiment.py", "if trainer.fraction < 1.0:", "if False:", CUT),
    of_host("compare: any folder", "reports/experiment.py", "if names and RECORD not in names:", "if False:", REFUSED),
    of_host("overlap: rays thin out by the distance", "scenes/cameras/overlap.py", "np.maximum(squared, distances[0] ** 2)",
            "np.sqrt(squared)", OVERLAP),
    # photograph_errors.py
    of_host("photographs: early rays count", ERRORS, "if fraction < LATE:", "if False:", OPAQUE_COUNT),
    of_host("photographs: transparent pixels are of the last", ERRORS, "counts = views >= 0", "counts = views >= -1; views = abs(views)", OPAQUE_COUNT),
    of_host("photographs: few rays tell", ERRORS, "if count >= FEWEST_RAYS", "if count", OPAQUE_COUNT),
    of_host("photographs: the error of all channels", ERRORS, "(3.0 * count)", "count", OPAQUE_COUNT),
    of_host("photographs: none looked at", TRAINER, "self.photograph_errors.add(self._views.numpy(), errors, self.fraction)", "pass", ELSE_TOLD),
    of_host("misfits: few dB", MISFITS, "max(BELOW, DEVIATIONS * deviation)", "DEVIATIONS * deviation", FAR_BELOW),
    of_host("misfits: few deviations", MISFITS, "max(BELOW, DEVIATIONS * deviation)", "BELOW", FAR_BELOW),
    of_host("misfits: mean deviations", MISFITS, "NORMAL * np.median(", "NORMAL * np.mean(", FAR_BELOW),
    of_host("misfits: the best first", MISFITS, "key=psnr.__getitem__", "key=lambda name: -psnr[name]", FAR_BELOW),
    of_host("misfits: of few photographs", MISFITS, "if len(psnr) < FEWEST:", "if not psnr:", FEW_TELL),
    of_host("misfits: not said", "cli/training.py", 'print(f"warning: {sentence}")', "pass", ARE_SAID),
]  # fmt: skip
