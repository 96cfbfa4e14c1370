"""Mutants of the host's code that measures, inspects, films and exports."""

from mutant import of_host

KNOWN = "evaluation/test_metrics.py::test_psnr_of_a_known_error"
SCIKIT = "evaluation/test_metrics.py::test_ssim_is_that_of_scikit_image"
MASKED = "evaluation/test_metrics.py::test_what_a_mask_hides_does_not_count"
BY_HAND = "evaluation/test_metrics.py::test_ssim_with_a_mask_by_hand"
FLIP = "evaluation/test_metrics.py::test_flip_is_that_of_its_package"
COUNTED = "evaluation/test_metrics.py::test_flip_is_a_mean_over_the_pixels_that_count"
OWN_PICTURES = "evaluation/test_evaluation.py::test_a_field_scores_well_on_its_own_pictures"
HIDDEN = "evaluation/test_evaluation.py::test_what_masks_hide_is_not_measured"
OVER = "evaluation/test_evaluation.py::test_alpha_is_seen_over_the_background_of_the_field"
FOG = "evaluation/test_evaluation.py::test_a_view_that_is_fog_is_told"
MASS = "evaluation/test_near_field.py::test_mass_of_even_density"
ENDS = (
    "evaluation/test_near_field.py::test_a_ray_ends_where_its_light_comes_from_if_half_of_it_does"
)
QUARTER = (
    "evaluation/test_near_field.py::test_what_hangs_before_one_of_four_cameras_counts_for_a_quarter"
)
PULLED = "evaluation/test_near_field.py::test_pulled_back_cameras_see_what_their_photographs_show"
NEAR_DENSITY = "evaluation/test_floater_metrics.py::test_near_density_is_density_times_clearance"
EVENLY = "evaluation/test_floater_metrics.py::test_directions_are_spread_evenly"
ON_THEIR_WAY = "fields/test_hashed_training.py::test_gradients_on_their_way_count"
PHOTOGRAPHS = "inspection/test_inspection.py::test_photographs_take_memory"
VOXELS = (
    "inspection/test_inspection.py::test_voxels_are_described_where_they_say_how_fine_a_field_is"
)
COSTS = "inspection/test_inspection.py::test_costs_grow_with_what_is_asked"
OF_MODEL = "inspection/test_inspection.py::test_costs_are_those_of_the_model"
UPDATES = "inspection/test_inspection.py::test_fewer_updates_cost_less_by_their_nodes"
ORDINARY = "inspection/test_inspection.py::test_an_ordinary_scene"
ORBIT = "media/test_camera_path.py::test_an_orbit_is_as_far_away_as_the_cameras_on_that_side"
ROUND = "media/test_camera_path.py::test_an_orbit_goes_all_the_way_round_at_the_cameras_distance"
SIDE = "media/test_camera_path.py::test_an_orbit_stays_on_the_side_that_was_photographed"
EVEN = "media/test_camera_path.py::test_through_goes_at_even_speed_however_far_cameras_are_apart"
LEAPING = (
    "media/test_camera_path.py::test_cameras_in_no_order_are_visited_from_neighbour_to_neighbour"
)
BACK = "media/test_camera_path.py::test_back_begins_at_the_cameras_and_ends_behind_them"
NINETY = "media/test_camera_path.py::test_through_a_fisheye_a_path_sees_ninety_degrees_at_most"
SMOOTH = "media/test_camera_path.py::test_paths_are_smooth_and_upright"
FAINTEST = "exporting/test_splats.py::test_the_faintest_cell_that_gets_a_splat_has_two_hundredths"
FOG_SPLATS = "exporting/test_splats.py::test_matter_of_even_density_is_as_opaque"
DILOGARITHM = "exporting/test_splats.py::test_opacities_have_the_dilogarithms_that_are_known"
LIKE_FIELD = "exporting/test_splats.py::test_a_ball_of_splats_looks_like_the_field"
CELLS = "exporting/test_splats.py::test_splats_of_folded_space_are_as_large_as_their_cells"
FIELDS = "exporting/test_splats.py::test_the_file_has_the_fields_of_3dgs_in_their_order"
LIGHT = "exporting/test_sight.py::test_all_light_comes_from_some_node"
NO_PART = "rendering/test_composite.py::test_what_is_no_part_of_a_field_is_refused"
COLOURS = "exporting/test_sight.py::test_colours_are_means_over_the_pixels_that_see_them"
HALF = "exporting/test_sight.py::test_pixels_that_do_not_count_see_nothing"
CIRCLE = "exporting/test_sight.py::test_corners_outside_of_a_fisheyes_circle_see_nothing"
BALL = "exporting/test_mesh.py::test_a_ball_is_closed_and_has_its_volume"
ON_BALL = "exporting/test_mesh.py::test_vertices_lie_on_the_ball_and_normals_point_outward"
ADDED = "exporting/test_mesh.py::test_what_is_added_to_raw_densities_counts"
SEEN_ONLY = "exporting/test_mesh.py::test_only_what_cameras_see_is_kept"
LINEAR = "exporting/test_mesh.py::test_linear_light_is_that_of_the_standard"
UPRIGHT = "exporting/test_mesh.py::test_any_up_is_turned_to_y"
NODES = "exporting/test_volume.py::test_npz_holds_density_and_colour_at_nodes"
BLOCK = "exporting/test_volume.py::test_unseen_nodes_are_empty_and_a_crop_is_a_block"
DISPARITY = "media/test_pictures.py::test_over_a_wide_range_equal_steps_of_disparity_look_equal"

METRICS, EVALUATE, NEAR_FIELD, FLOATERS, INSPECTION = (
    *(f"evaluation/{name}.py" for name in ("metrics", "evaluate", "near_field", "floater_metrics")),
    "inspection/inspection.py",
)
SPLATS, VISIBILITY, MESH, SURFACE, VOLUME = (
    f"exporting/{name}.py" for name in ("splats", "visibility", "mesh", "surface", "volume")
)
PATH = "media/camera_path.py"

MUTANTS = [
    # metrics.py
    of_host("psnr: of the root", METRICS, "return -10.0 * math.log10", "return -20.0 * math.log10", KNOWN),
    of_host("psnr: all pixels", METRICS, "[... if mask is None else mask] ** 2", "[...] ** 2", MASKED),
    of_host("ssim: window", METRICS, "_SIGMA = 1.5", "_SIGMA = 1.0", SCIKIT),
    of_host("ssim: constant", METRICS, "0.01**2, 0.03**2", "0.01**2, 0.01**2", SCIKIT),
    of_host("ssim: weights of what does not count", METRICS, "return _blur(weights * image) / total",
            "return _blur(weights * image)", BY_HAND),
    of_host("ssim: all windows", METRICS, "similarity if middles is None else similarity[middles]", "similarity", BY_HAND),
    of_host("flip: by other colours", METRICS, "evaluate(reference, test, \"LDR\"", "evaluate(reference, 0.9 * test, \"LDR\"", FLIP),
    of_host("flip: of all, with a mask", METRICS, "np.asarray(errors).reshape(mask.shape)[mask].mean()", "mean", COUNTED),
    of_host("flip: all pixels", METRICS, "    a = alike_where_masked(a, b, mask)\n", "", MASKED),
    # evaluate.py
    of_host("depth error with its sign", EVALUATE, "np.mean(np.abs(rendering.depth - depth)[known])",
            "np.mean((rendering.depth - depth)[known])", OWN_PICTURES),
    of_host("depth error of what is masked", EVALUATE, " & (True if mask is None else mask)", "", HIDDEN),
    of_host("LPIPS of what is masked", EVALUATE, "lpips(alike, target)", "lpips(rgb, target)", HIDDEN),
    of_host("SSIM of what is masked", EVALUATE, "ssim=ssim(rgb, target, mask)", "ssim=ssim(rgb, target)", HIDDEN),
    of_host("before black", METRICS, "+ (1.0 - alpha) * np.array(background)", "", OVER),
    of_host("fog: close-ups as well", EVALUATE, " and i.psnr < FOG_PSNR", "", FOG),
    of_host("near rays: of ten times as near", EVALUATE, "within = NEAR_SHARE * scene.content_distance",
            "within = NEAR_SHARE * NEAR_SHARE * scene.content_distance", FOG),
    # near_field.py, floater_metrics.py
    of_host("near rays without opacity", NEAR_FIELD, "(seen.opacity >= 0.5) & ", "", ENDS),
    of_host("near rays: depth of all light", NEAR_FIELD, "seen.depth < distance * seen.opacity", "seen.depth < distance",
            ENDS),
    of_host("near mass: light that ends early", "rendering/field.py", "far=far, transmittance_min=0.0", "far=far", QUARTER),
    of_host("near mass: all of a ray", "rendering/field.py", "far=far, transmittance_min=0.0", "transmittance_min=0.0", MASS),
    of_host("NEAR_SHARE", NEAR_FIELD, "NEAR_SHARE = 0.1", "NEAR_SHARE = 0.2", MASS),
    of_host("pulled: twice as far", NEAR_FIELD, "PULLED_SHARE = 0.2", "PULLED_SHARE = 0.4", PULLED),
    of_host("near density: as opacity", FLOATERS, "-np.log(np.maximum(1.0 - seen.opacity, 1e-6)).mean()",
            "seen.opacity.mean()", NEAR_DENSITY),
    of_host("directions: one half", FLOATERS, "z = 1.0 - 2.0 * k / n", "z = 1.0 - k / n", EVENLY),
    # inspection.py
    of_host("memory without gradients on their way", "training/plan.py", "of_rays + of_samples +", "of_rays +", ON_THEIR_WAY),
    of_host("memory of gradients on their way on one thread", "training/plan.py", "usable_cores()) == 1", "usable_cores()) == 0",
            ON_THEIR_WAY),
    of_host("memory of gradients without their positions", "model/storage_kinds.py", "4 * (3 + -(-self.levels", "4 * (-(-self.levels",
            ON_THEIR_WAY),
    of_host("memory without photographs", "training/plan.py", "+ images + PROCESS_BYTES", "+ PROCESS_BYTES", PHOTOGRAPHS),
    of_host("memory of four numbers a node", "model/storage_kinds.py", "math.prod(size) * model.n_floats * NUMBER_BYTES",
            "math.prod(size) * 4 * NUMBER_BYTES", OF_MODEL),
    of_host("time of any model", INSPECTION, "step *= config.model.relative_time * ", "step *= ", OF_MODEL),
    of_host("voxels of a hash are described", INSPECTION, "if cost.plan.config.field.as_fine_as_nodes:", "if True:", VOXELS),
    of_host("time on one thread", INSPECTION, "config.steps * step / threads", "config.steps * step", COSTS),
    of_host("every step updates", INSPECTION, "(nodes / steps_an_update).mean()", "nodes.mean()", UPDATES),
    of_host("half the field of view", INSPECTION, "math.degrees(2.0 * half)", "math.degrees(half)", ORDINARY),
    # camera_path.py
    of_host("orbit: as far all round", PATH, "np.exp(4.0 * (np.cos(angles - angle) - 1.0))", "np.ones_like(angles)", ORBIT),
    of_host("orbit: at one height", PATH, "weights @ heights", "heights.mean()", ORBIT),
    of_host("orbit: from the other side", PATH, "focus + radius * outward", "focus - radius * outward", ORBIT),
    of_host("orbit: half of it", PATH, "turn = 2.0 * np.pi * np.arange", "turn = np.pi * np.arange", ROUND),
    of_host("orbit: all the way", PATH, "FULL_CIRCLE_GAP = np.radians(100.0)", "FULL_CIRCLE_GAP = np.radians(400.0)", SIDE),
    of_host("through: from key to key in one time", PATH, "np.interp(even, [0.0, *travelled], fine)",
            "np.linspace(0.0, len(keys) - 1.0, n_frames)", EVEN),
    of_host("through: turning takes no time", PATH, "content_distance * np.linalg.norm(turned", "0.0 * np.linalg.norm(turned",
            EVEN),
    of_host("through: leaps", PATH, "LEAPS = 0.7", "LEAPS = 7.0", LEAPING),
    of_host("back: without ease", PATH, "return x * x * (3.0 - 2.0 * x)", "return 1.0 - x", BACK),
    of_host("back: as far as content", PATH, "BACK_SHARE = 0.5", "BACK_SHARE = 1.0", BACK),
    of_host("lens: what a fisheye sees", PATH, "min(float(angle), 0.25 * math.pi)", "float(angle)", NINETY),
    of_host("lens: up to 85 degrees", PATH, "0.25 * math.pi", "math.radians(85.0)", NINETY),
    of_host("spline: no rotations", PATH, "    poses[:, :, :3] = u @ vt\n", "", SMOOTH),
    # splats.py
    of_host("splats: of what is half opaque", SPLATS, "FAINTEST = 0.02", "FAINTEST = 0.3", FAINTEST),
    of_host("splats: as large as a voxel", SPLATS, "return SPREAD * stretch, ", "return 2.0 * SPREAD * stretch, ", CELLS),
    of_host("splats: as opaque as a cell", SPLATS, "sigma / (2.0 * math.pi * SPREAD**2 * crossed)", "sigma / crossed",
            FOG_SPLATS),
    of_host("splats: half of the series", SPLATS, "(table[:, None] ** n / n**2)", "(table[:, None] ** n / n)", DILOGARITHM),
    of_host("splats: the inside as well", SPLATS, "    if visibility is not None and not unseen:\n", "    if False:\n", LIKE_FIELD),
    of_host("splats: colours as they are", SPLATS, "(splats.rgb - 0.5) / FIRST_HARMONIC", "splats.rgb / FIRST_HARMONIC", FIELDS),
    of_host("splats: opacity as it is", SPLATS, "np.log(opacity) - np.log1p(-opacity)", "opacity", FIELDS),
    # sight.py
    of_host("visibility: a mean", VISIBILITY, "adjoint.run(field.free, batch, n_batches=len(shown))", "adjoint.run(field.free, batch)",
            LIGHT),
    of_host("visibility: slope of one", VISIBILITY, "SIGMOID_SLOPE = 0.25", "SIGMOID_SLOPE = 1.0", LIGHT),
    of_host("visibility: grey", VISIBILITY, "((light, np.ones_like(shown)), (colour, shown))",
            "((light, np.ones_like(shown)), (colour, np.ones_like(shown)))", COLOURS),
    of_host("visibility: masks are not minded", VISIBILITY, "isinstance(view, View) and mask is not None:", "False:", HALF),
    of_host("visibility: corners of a fisheye", VISIBILITY, "return share if seen is None else share * seen", "return share", CIRCLE),
    # surface.py, mesh.py, volume.py
    of_host("mesh: inside out", SURFACE, ".reshape(-1, 3)[:, ::-1]", ".reshape(-1, 3)", BALL),
    of_host("mesh: normals inward", "rendering/normals.py", "falling[:, axis] = before - after", "falling[:, axis] = after - before", ON_BALL),
    of_host("mesh: level without the shift", SURFACE, " - field.storage.density_shift\n", "\n",
            ADDED),
    of_host("density without the shift", SURFACE, "raw + stored.density_shift", "raw", ADDED),
    of_host("mesh: what none sees", SURFACE, "kept &= values_at(visibility.light, nodes) > SEEN", "pass", SEEN_ONLY),
    of_host("mesh: light of 2.2", MESH, "((rgb + 0.055) / 1.055) ** 2.4", "rgb**2.2", LINEAR),
    of_host("mesh: up turned away from y", MESH, "np.array([-z, 0.0, x, 1.0 + y])", "np.array([z, 0.0, -x, 1.0 + y])", UPRIGHT),
    of_host("volume: what none sees", VOLUME, "there = np.ones_like(seen) if unseen else seen", "there = np.ones_like(seen)",
            BLOCK),
    of_host("volume: raw", VOLUME, "density(field, raw[block])", "raw[block]", NODES),
    # field.py, composite.py: arguments
    of_host("field: any distance", "rendering/field.py", "if not distance >= 0.0:", "if distance < 0.0:", NO_PART),
    of_host("field: a crop upside down", "rendering/field.py", "x < y for x, y", "True for x, y", NO_PART),
    of_host("composite: cells upside down", "rendering/composite.py",
            " or not (self.cells[:, 0] < self.cells[:, 1]).all()", "",
            "rendering/test_composite.py::test_cells_are_boxes_one_for_each_member"),
    # pictures.py
    of_host("pictures: depth in all ranges", "media/pictures.py", "return far > DISPARITY_FROM * near > 0.0", "return False",
            DISPARITY),
]  # fmt: skip
