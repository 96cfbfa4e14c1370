"""Mutants of what changes in the course of a training: averaged pixels, a loss's weight."""

from mutant import Mutant, of_host

TESTS = "training/test_coarse_to_fine.py::test_"
HALFWAY, REFUSED, GAINS, AVERAGED, WIDEST = (
    f"{TESTS}{name}"
    for name in (
        "halfway_a_weight_is_what_is_configured",
        "a_rise_that_is_none_is_refused",
        "a_loss_gains_weight_from_update_to_update",
        "pixels_are_averaged_until_the_grid_has_grown",
        "no_square_is_wider_than_four_pixels",
    )
)
SQUARE = "kernels/test_drawn_pixels.py::test_pixels_are_averaged_over_a_square"
OLDER = "model/test_presets.py::test_what_older_files_leave_out_is_what_was_the_default_then"
CAMERA, CONFIG = "space/camera.py", "loss_config.py"
TRAINER, GROWTH, PASS = "training/trainer.py", "training/growth.py", "rendering/render.py"

MUTANTS = [
    # camera.py
    Mutant("average: as if all were opaque", CAMERA, "rgb += alpha * (unit", "rgb += share * (unit", SQUARE),
    Mutant("average: whole pixels", CAMERA, "wp.clamp(within, real(0.0), real(1.0))", "wp.where(within > real(0.0), real(1.0), real(0.0))",
           SQUARE),
    Mutant("average: a pixel less", CAMERA, "return int(wp.ceil((wp.max(edge, real(1.0)) - real(1.0)) * real(0.5)))",
           "return int((wp.max(edge, real(1.0)) - real(1.0)) * real(0.5))", SQUARE),
    Mutant("average: of what is cut off", CAMERA, "if reach > 0 and (darkest", "if reach < 0 and (darkest", SQUARE),
    Mutant("average: cut off at black only", CAMERA, " or brightest == wp.uint8(255)", "", SQUARE),
    Mutant("average: of what is masked", CAMERA, "wp.where(view.runs.shape[0] > 0, real(1.0), wp.max(edge, real(1.0)))",
           "wp.max(edge, real(1.0))", SQUARE),
    Mutant("average: of no pixels", CAMERA, "wp.max(edge, real(1.0)))\n    reach", "edge)\n    reach", SQUARE),
    Mutant("average: not to the last row", CAMERA, "0, view.height - 1)", "0, view.height - 2)", SQUARE),
    Mutant("average: not to the last column", CAMERA, "x = wp.clamp(column + right, 0, width - 1)",
           "x = wp.clamp(column + right, 0, width - 2)", SQUARE),
    Mutant("average: a sum", CAMERA, "return whole * rgb, whole * sum_alpha", "return rgb, whole * sum_alpha", SQUARE),
    # loss_config.py
    of_host("rise: from what is configured", CONFIG, "math.floor(100 * fraction) / 100 - 0.5", "math.floor(100 * fraction) / 100", HALFWAY),
    of_host("rise: at all times another", CONFIG, "math.floor(100 * fraction) / 100", "fraction", HALFWAY),
    of_host("rise: twice", CONFIG, "distortion=weight, distortion_rise=1.0", "distortion=weight", HALFWAY),
    of_host("rise: any number", CONFIG, '        require_positive("loss.distortion_rise", self.distortion_rise)\n', "", REFUSED),
    of_host("rise: beyond what floats hold", CONFIG, "1e-20 < self.distortion < 1e20", "True",
            f"{TESTS}a_weight_that_floats_do_not_hold_is_refused"),
    # trainer.py, render.py
    of_host("rise: never", TRAINER, "        self._pass.minimise(self._objective(fraction))\n",
            "        self._pass.minimise(self._objective(0.0))\n", GAINS),
    of_host("rise: kernels do not learn of it", PASS, "            self._scene.loss = loss_struct(self._model, \"float32\", objective)\n",
            "", GAINS),
    of_host("average: not at first", TRAINER, "        self._sampler.average_over(averaged_over(plan, self._grown))\n", "", AVERAGED),
    of_host("average: for ever", TRAINER, "        self._sampler.average_over(averaged_over(self.plan, grown))\n", "", AVERAGED),
    of_host("average: a mask of all pixels", "rendering/rays.py", "if mask is None or mask.all():", "if mask is None:",
            "rendering/test_rays.py::test_a_mask_of_all_pixels_changes_no_bit"),
    of_host("limits: of coarser grids", "reports/limits.py", "report.size == size for", "True for",
            "reports/test_limits.py::test_a_fall_is_called_so_and_is_for_want_of_time_where_the_grid_has_just_grown"),
    # growth.py, config_json.py
    of_host("average: as many as voxels", GROWTH, "** (1.0 / 3.0)", "** (1.0 / 2.0)", AVERAGED),
    of_host("average: unasked", GROWTH, "if not plan.config.average_pixels or", "if", AVERAGED),
    of_host("average: everywhere", GROWTH, " or plan.kind == \"bounded\":", ":", f"{TESTS}bounded_scenes_without_alpha_are_not_averaged"),
    of_host("average: wide squares", GROWTH, "min(edge, MOST_AVERAGED)", "edge", WIDEST),
    of_host("average: in older trainings", "config_json.py", '        "average_pixels": False,\n', "", OLDER),
]  # fmt: skip
