"""Mutants of what the host makes of scenes: where cameras look, lenses, what they see."""

from mutant import of_host

AS_MUCH = "scenes/test_points.py::test_a_camera_counts_as_much_as_another"
OWN = "scenes/test_points.py::test_distances_are_each_camera_s_own"
FEW = "scenes/test_points.py::test_too_few_points_tell_nothing"
TRACK = "scenes/test_points.py::test_a_track_tells_what_is_seen_and_else_the_picture"
BOTH = "training/test_coarse.py::test_the_box_around_a_common_focus_stays"
LARGEST = "scenes/test_lens.py::test_a_fisheye_sees_as_far_aside_as_its_polynomial_rises"
OFFSET = "scenes/test_points.py::test_an_off_centre_principal_point_counts"
WIDE = "scenes/test_points.py::test_a_fisheye_lens_sees_by_the_angle"
CIRCLE = "scenes/test_overlap.py::test_cameras_around_a_thing_all_see_it"
AXES = "scenes/test_focus.py::test_focus_minimises_squared_distance_to_the_axes"
OBJECT_BOX = "scenes/test_focus.py::test_box_of_an_object_is_what_the_larger_field_of_view_spans"
OUTWARD = "scenes/test_focus.py::test_cameras_that_look_outward_fall_back_to_their_spread"
PARALLEL = "scenes/test_focus.py::test_nearly_parallel_axes_have_no_focus"
MEETING = "scenes/test_focus.py::test_axes_that_point_anywhere_far_from_the_origin_have_no_focus"
CONTRADICTS = (
    "scenes/test_lens.py::test_a_focal_length_and_an_angle_that_contradict_each_other_are_told"
)
KIND = "scenes/test_lens.py::test_of_two_kinds_of_lenses_the_model_is_used"
SIZES = "scenes/test_transforms.py::test_one_lens_for_images_of_other_sizes_is_told"
LEFT = "scenes/test_masks.py::test_masks_that_leave_less_than_half_are_told_but_where_they_leave_the_focus"
BOUNDS = "scenes/test_given_depths.py::test_bounds_in_other_units_are_not_used"
UNIT = "scenes/test_given_depths.py::test_depth_maps_in_other_units_are_told"
FROZEN = "inspection/test_inspection.py::test_the_same_photograph_at_other_poses_is_said"
NEARLY_BLACK = "inspection/test_inspection.py::test_photographs_that_are_nearly_black_are_said"
STILL = "inspection/test_inspection.py::test_pixels_that_are_the_same_in_all_photographs_are_said"
NOT_SEEN = (
    "inspection/test_inspection.py::test_still_pixels_that_are_masked_or_transparent_are_not_said"
)
LOST = "scenes/test_focus.py::test_a_few_cameras_far_away_from_all_others_do_not_count"
PLACES = "scenes/test_focus.py::test_cameras_far_away_count_where_they_are_many_or_the_others_are_in_one_place"
UP = "scenes/test_focus.py::test_up_is_found_in_upright_photographs_that_all_look_down"
AIMED = "scenes/test_focus.py::test_share_of_cameras_aimed_at_a_point"
NDC = "scenes/test_frustum.py::test_coordinates_and_back"
DEPTHS = "scenes/test_depths.py::test_depth_is_along_the_ray"
UNKNOWN = "scenes/test_depths.py::test_what_is_not_known_is_not_finite"
WIDTHS = "scenes/test_space.py::test_widths_are_those_of_the_contraction_s_own_jacobian"
FRUSTUM = "scenes/test_space.py::test_widths_in_a_frustum_are_those_of_its_coordinates"
WIDE_BOX = "scenes/test_space.py::test_in_a_box_a_voxel_is_as_wide_as_its_edge_has_pixels"
AS_MUCH_SEEN = "scenes/test_space.py::test_each_camera_weighs_as_much_however_much_it_sees"
TABLE = "scenes/test_space_plan.py::test_a_table_in_a_room_gets_a_box_of_its_own"
LEAST = "scenes/test_space_plan.py::test_the_plan_is_that_of_the_least_error_and_does_not_depend_on_the_voxels"
FOLLOWS = "scenes/test_space_plan.py::test_a_scene_s_space_follows_its_configuration"
NODES = "exporting/test_sight.py::test_node_coordinates_are_those_that_kernels_read"
MESH = "exporting/test_mesh.py::test_folded_space_comes_out_in_scene_units"
BEHIND = "scenes/test_frustum.py::test_node_coordinates_are_those_that_kernels_read"
NO_RAYS = "scenes/test_camera.py::test_what_makes_no_rays_is_refused"
BY_HAND = "scenes/test_scene.py::test_a_scene_that_nothing_can_be_trained_on_is_refused"
BLOCKS = "scenes/test_masks.py::test_a_pixel_that_stands_for_several_counts_if_all_do"

POINTS, FOCUS, OVERLAP, FISHEYE = (
    "scenes/extent/points.py",
    *(f"scenes/cameras/{name}.py" for name in ("focus", "overlap", "fisheye")),
)

LENS, FRAME = "scenes/cameras/lens.py", "scenes/formats/frame.py"
DIAGNOSTICS = "inspection/diagnostics.py"
GIVEN, CONSISTENCY = "scenes/extent/given_depths.py", "scenes/extent/photo_consistency.py"
SWEPT = "scenes/test_swept.py::test_the_content_distance_of_a_room"
SURFACES = "scenes/test_swept.py::test_places_lie_on_surfaces"
MASKED = "scenes/extent/masked.py"
SPACES = "model/spaces.py"
SPACE, SPACE_PLAN, OBSERVATIONS = (
    f"scenes/{name}.py" for name in ("extent/space", "extent/space_plan", "cameras/observations")
)

DOUBTS = "scenes/extent/doubts.py"
ANY_FOCAL, FOCAL, HARDLY, OTHER_POSES = (
    f"scenes/test_doubts.py::test_{name}"
    for name in (
        "focal_lengths_that_cameras_do_not_tell_are_believed",
        "focal_lengths_of_another_size_are_named",
        "photographs_that_hardly_overlap_refute_nothing",
        "photographs_of_other_poses_are_named",
    )
)
CLASSES = "scenes/test_class_masks.py::test_masks_of_classes_are_told"
READ_AS = "scenes/test_conventions.py::test_poses_in_other_axes_are_read_as_the_photographs_show"

CONVENTIONS = "scenes/extent/conventions.py"
PROVED = (
    "scenes/test_conventions.py::test_a_part_is_proved_by_nearly_every_reference_and_by_the_whole"
)
FEWER = "scenes/test_focus.py::test_cameras_upside_down_are_the_fewer"
DRONE = "scenes/test_focus.py::test_no_camera_of_a_drone_that_flies_to_and_fro_is_upside_down"
BENT = "scenes/test_doubts.py::test_distortion_of_photographs_without_is_named"
UNFIT = "scenes/test_doubts.py::test_photographs_of_which_some_do_not_fit_are_counted"
TESTING = "scenes/test_doubts.py::test_photographs_for_testing_are_looked_at_as_well"
MIRROR = "scenes/test_doubts.py::test_mirrored_photographs_are_named"
MATTES = "scenes/test_class_masks.py::test_mattes_with_wide_soft_edges_are_no_photographs"
TRACKS = "inspection/test_places.py::test_straight_tracks_are_no_degrees"
TWO_PLACES = "inspection/test_places.py::test_two_places_are_in_the_same_units"
OF_ANOTHER = "scenes/test_transforms.py::test_files_of_another_machine_are_none_of_another_path"

MUTANTS = [
    # doubts.py and conventions.py
    of_host("doubts: focal lengths that fit about as well", DOUBTS, "return zoom if sharp else None", "return zoom", ANY_FOCAL),
    of_host("doubts: focal lengths as they stand only", DOUBTS, "for steps in (ZOOMS, FINER):", "for steps in (FINER,):", FOCAL),
    of_host("doubts: the inverse factor", DOUBTS, "photographs.zoomed(middle * step)", "photographs.zoomed(1.0 / (middle * step))", FOCAL),
    of_host("doubts: of cameras far apart", DOUBTS, " and photographs.apart() <= CLOSE", "", HARDLY),
    of_host("doubts: of few references", DOUBTS, "len(gain) < ENOUGH or ", "", HARDLY),
    of_host("doubts: none of poses", DOUBTS, "if not some and gain.mean() < REFUTED and", "if False and", OTHER_POSES),
    of_host("doubts: not asked", "scenes/extent/conventions.py", "told = doubts(photographs)", "told = []", OTHER_POSES),
    of_host("positions: as translations", "scenes/extent/conventions.py", "-to_camera @ poses[:, :, 3:]], axis=2)", "poses[:, :, 3:]], axis=2)", READ_AS),
    of_host("left-handed: the camera alone", "scenes/extent/conventions.py", " * MIRRORED[:3, None]", "", READ_AS),
    of_host("masks: classes are no reason", "scenes/images/masks.py", "if 1 < values[-1] < 128:", "if False:", CLASSES),
    of_host("masks: JPEG's black is a class", "scenes/images/masks.py", "in LOSSY:", "in ():", CLASSES),
    of_host("pointers: of any file", "scenes/files.py", "beginning(path, len(POINTER)) == POINTER", "False", "scenes/test_pointers.py"),
    of_host("w last: w second", "scenes/extent/conventions.py", "np.roll(quaternions(to_camera), 1, axis=1)", "np.roll(quaternions(to_camera), 2, axis=1)", READ_AS),
    of_host("w last: positions as they were", "scenes/extent/conventions.py", "-turned @ moved], axis=2)", "poses[:, :, 3:]], axis=2)", READ_AS),
    of_host("widths: no bend", SPACES, "k = np.where(n > 1.0, (ahead - s) / (n * ahead), 0.0)", "k = 0.0 * n", WIDTHS),
    of_host("widths: across as ahead", SPACES, "s, ahead = self.shrink(n, placed.border),", "s, ahead = self.ahead(n, placed.border),", WIDTHS),
    of_host("widths: depth counts whole", SPACE, "(1.0 - depth_share * depth_share)", "0.0", WIDTHS),
    of_host("widths: the norm of the box", SPACES, "np.linalg.norm(q, axis=1)", "np.abs(q).max(axis=1)", WIDTHS),
    of_host("widths: depth in a frustum", SPACES, "w * w / (frustum.depth * frustum.near)", "w / frustum.depth", FRUSTUM),
    of_host("space: no border outside", SPACES, "return (1.0 + b - b / n) / n", "return 1.0 / n", NODES),
    of_host("space: near where c is outermost", SPACES, "return b / np.maximum(1.0 + b - m, 0.0)", "return m", MESH),
    of_host("space: what is behind cameras is ahead", SPACES, "nan=-1e6", "nan=0.0", BEHIND),
    of_host("outline: twice as far", SPACES, "* times <= 1.0", "* times <= 2.0",
            "scenes/test_space.py::test_outside_of_an_outline_voxels_are_as_much_wider"),
    of_host("spaces: any may have a name", SPACES, "kind.name == \"auto\" or type(", "False and type(",
            "kernels/test_seams.py::test_names_of_spaces_are_given_once"),
    of_host("widths: no pixels", SPACE, "* observations.pixels", "", WIDE_BOX),
    of_host("the shell is no space", SPACE, "* (1.0 + self.border)", "", "scenes/test_space.py::test_a_shell_takes_its_part_of_the_voxels"),
    of_host("a camera by its places", OBSERVATIONS, "1.0 / max(1, len(places))", "1.0", AS_MUCH_SEEN),
    of_host("a camera's all", OBSERVATIONS, "PER_CAMERA = (4, 40)", "PER_CAMERA = (4, 4000)", AS_MUCH_SEEN),
    of_host("wrong matches count", OBSERVATIONS, "NEAR, FAR = 0.1, 4.0", "NEAR, FAR = 0.0, 400.0",
            "scenes/test_space.py::test_matches_far_from_the_median_of_their_camera_are_left_out"),
    of_host("the worst plan", SPACE_PLAN, "np.argmin(errors)", "np.argmax(errors)", TABLE),
    of_host("small voxels for nothing", SPACE_PLAN, "PRICE = 0.8", "PRICE = 80.0", TABLE),
    of_host("boxes around everything", SPACE_PLAN, "yield middle - half, middle + half",
            "yield middle - 100.0 * half, middle + 100.0 * half", TABLE),
    of_host("a given box is planned", SPACE_PLAN, "    if box:\n", "    if True:\n",
            "scenes/test_space_plan.py::test_what_is_given_stays"),
    of_host("any gain is one", SPACE_PLAN, "errors[0] - MIN_GAIN", "errors[0] + 100.0",
            "scenes/test_space_plan.py::test_a_box_that_is_hardly_worse_than_the_best_is_kept"),
    of_host("unseen boxes", SPACE_PLAN, "        _require_seen(scene, low, high)\n", "",
            "scenes/test_space_plan.py::test_a_box_that_no_camera_sees_is_refused"),
    of_host("content forgotten", SPACE_PLAN, "return replace(space, content=content)", "return space", FOLLOWS),
    of_host("blur of no power", SPACE_PLAN, "BLUR_POWER = 1.25", "BLUR_POWER = 0.05", TABLE),
    of_host("a camera by its points", POINTS, "1.0 / max(len(a), FEW)", "1.0", AS_MUCH),
    of_host("all that are far behind", POINTS, "BACKGROUND = 4.0", "BACKGROUND = 4000.0",
            "scenes/test_points.py::test_wrong_points_change_little"),
    of_host("one distance for all", POINTS, "distances = np.where(np.isfinite(own), own, content_distance)",
            "distances = np.full(len(own), content_distance)", OWN),
    of_host("mean of all cameras", POINTS, "np.nanmedian(own[list(training)])", "np.nanmedian(own)", OWN),
    of_host("few points tell", POINTS, "len(a) >= FEW else", "len(a) > FEW else", FEW),
    of_host("few cameras tell", POINTS, "MIN_SHARE = 0.5", "MIN_SHARE = 0.2", FEW),
    of_host("behind the camera", POINTS, "points[(points - camera.position) @ camera.forward > 0.0]", "points", TRACK),
    of_host("found boxes for all", POINTS, "box_max=observed.box_max if scene.guessed else scene.box_max",
            "box_max=observed.box_max", BOTH),
    of_host("fisheye: up to 85 degrees", FISHEYE, "if falls.any() else math.pi",
            "if falls.any() else math.radians(85.0)", LARGEST),
    of_host("fisheye: a little less", FISHEYE, "MIN_SLOPE = 0.01", "MIN_SLOPE = 0.2", LARGEST),
    of_host("fisheye: as the table says", FISHEYE, "for _ in range(3):", "for _ in range(0):", LARGEST),
    of_host("fisheye: slope of the first term", FISHEYE, "t2 * (3.0 * k1", "t2 * (k1", LARGEST),
    of_host("in picture: the middle", OVERLAP, "camera.cx + camera.fx * x", "0.5 * camera.width + camera.fx * x", OFFSET),
    of_host("in picture: upside down", OVERLAP, "camera.cy - camera.fy * y", "camera.cy + camera.fy * y", OFFSET),
    of_host("in picture: a fisheye as a plane", OVERLAP, "np.arctan2(aside, -z) / aside", "-1.0 / z", WIDE),
    of_host("content behind", OVERLAP, "camera.position + along", "camera.position - along", CIRCLE),
    of_host("focus: along the axes", FOCUS, "np.eye(3) - axes[:, :, None]", "np.eye(3) + axes[:, :, None]", AXES),
    of_host("focus: nearly parallel", FOCUS, "least < NEARLY_PARALLEL", "least < 0.0", PARALLEL),
    of_host("focus: spread", FOCUS, "centres - centres.mean(axis=0), mean", "centres, mean", MEETING),
    of_host("focus: behind cameras", FOCUS, "if np.mean(depths > 0.0) >= MIN_SHARE_IN_FRONT:", "if True:", OUTWARD),
    of_host("focus: far cameras count", FOCUS, "FAR_OFF = 10.0", "FAR_OFF = 1e9", LOST),
    of_host("focus: far cameras never count", FOCUS, "MAX_SHARE_FAR_OFF = 0.25", "MAX_SHARE_FAR_OFF = 0.9", PLACES),
    of_host("focus: nearly all in one place", FOCUS, " and np.ptp(centres[near], axis=0).any()", "", PLACES),
    of_host("box: the smaller field of view", FOCUS, "max(camera.width / camera.fx, camera.height / camera.fy) / 2",
            "min(camera.width / camera.fx, camera.height / camera.fy) / 2", OBJECT_BOX),
    of_host("up: level", FOCUS, "directions[:, 0] * np.sign(directions[:, 0] @ mean)",
            "directions[:, 2] * np.sign(directions[:, 2] @ mean)", UP),
    of_host("up: the cameras' own", FOCUS, "return normal if level and normal @ mean > 0.5 else mean", "return mean", UP),
    of_host("aimed: the whole picture", FOCUS, "u < -0.25 * camera.width * z", "u < -0.5 * camera.width * z", AIMED),
    of_host("lens: an angle beside a right one", LENS, "            if values.get(\"fl_y\") == used:  # Blender's angle_y may be that of its sensor\n                break\n", "", CONTRADICTS),
    of_host("lens: no angle along the longer side", LENS, "if axis == \"x\" else other", "if axis == \"z\" else other", CONTRADICTS),
    of_host("lens: squares stand upright", LENS, "if height <= width or", "if height < width or",
            "scenes/test_transforms.py::test_an_angle_across_the_width_of_portraits_is_said"),
    of_host("lens: any angle is right", LENS, "MAX_DIFFERENCE = 0.01", "MAX_DIFFERENCE = 10.0", CONTRADICTS),
    of_host("lens: an angle of another level", LENS, "angles |= {name", "angles |= {} and {name", CONTRADICTS),
    of_host("lens: is_fisheye decides", LENS, "            fisheye = level.camera_model == FISHEYE\n",
            "            fisheye = bool(level.is_fisheye)\n", KIND),
    of_host("lens: an angle of all shapes", FRAME, "SAME_LENS = 0.01", "SAME_LENS = 10.0", SIZES),
    of_host("lens: an angle of no other shape", FRAME, "same[:2].all() or (by_angle and same[2:].all())", "same[:2].all()", SIZES),
    of_host("lens: oblong pixels", DIAGNOSTICS, "SQUARE = 1.2", "SQUARE = 2.0",
            "inspection/test_inspection.py::test_lenses_in_other_units_are_said"),
    of_host("ndc: depth as it is", "scenes/extent/frustum.py", "self.depth * (1.0 - self.near / w)", "1.0 - self.near / w", NDC),
    of_host("depth: along the axis", "scenes/images/depths.py", "np.divide(along, cosine,", "np.divide(along, np.ones_like(cosine),",
            DEPTHS),
    of_host("depth: no unit", "scenes/images/depths.py", ".astype(np.float64) * self.unit", ".astype(np.float64)", DEPTHS),
    of_host("depth: what cannot be read is not said", "scenes/images/depths.py", "return None, str(error)", "return None, \"\"",
            "scenes/test_depths.py::test_depth_that_cannot_be_read_is_left_out"),
    of_host("depth: none is none", "scenes/images/depths.py", " & (along > 0.0)", "", UNKNOWN),
    of_host("bounds: any are right", GIVEN, "support >= SUPPORTED:\n        return bounds", "support >= 0.0:\n        return bounds", BOUNDS),
    of_host("bounds: never right", GIVEN, "SUPPORTED = 0.7", "SUPPORTED = 1.5",
            "scenes/test_given_depths.py::test_bounds_that_hold_what_photographs_show_are_used"),
    of_host("bounds: photographs that fit nothing", CONSISTENCY, " and self.agreement.fits", "",
            "scenes/test_given_depths.py::test_photographs_that_fit_nothing_refute_no_depths"),
    of_host("depth maps: the other way", GIVEN, "1.0 / (unit * sampled", "unit / (1.0 * sampled", UNIT),
    of_host("depth maps: no inverse ones", GIVEN, "REFUTED = 0.5", "REFUTED = 0.0",
            "scenes/test_given_depths.py::test_inverse_depths_and_depths_of_others_are_told"),
    of_host("depth maps: of a pinhole", GIVEN, "camera.distort((middles * size - centre) / focal)[0]", "((middles * size - centre) / focal)",
            "scenes/test_given_depths.py::test_a_map_is_read_where_the_lens_shows_what_a_pinhole_does"),
    of_host("sweep: any depth is sure", CONSISTENCY, "(highest >= SURE) & (highest >= others + AHEAD)", "highest > 0.0", SURFACES),
    of_host("sweep: one neighbour is as good as three", CONSISTENCY, "ALONE = 0.15", "ALONE = -0.3", SURFACES),
    of_host("sweep: no depths between", CONSISTENCY, "(best + step) * inverse[1]", "(best + 1.0 + step) * inverse[1]", SURFACES),
    of_host("sweep: small photographs", "scenes/extent/swept.py", ">= LEAST_SIDE", ">= 0",
            "scenes/test_swept.py::test_photographs_of_another_size_are_left_out"),
    of_host("sweep: each process for itself", "training/coarse.py", "peers.from_first(lambda: extent_by_sweep(scene))", "extent_by_sweep(scene)",
            "scenes/test_swept.py::test_the_first_process_compares_for_all"),
    of_host("sweep: what is infinitely far is a place", CONSISTENCY, "(best > 0) & ", "",
            "scenes/test_swept.py::test_what_is_infinitely_far_is_no_place"),
    of_host("sweep: the best depth is beside itself", CONSISTENCY, "- best) <= FINE_DEPTHS // DEPTHS", "- best) <= -1", SWEPT),
    of_host("sweep: masks are not minded", CONSISTENCY, "        if mask is not None:\n            u, v", "        if False:\n            u, v",
            "scenes/test_swept.py::test_what_a_mask_leaves_out_does_not_count"),
    of_host("sweep: along the axis", CONSISTENCY, "rays[:, :2] = (middles - picture.centre) / picture.focal", "rays[:, :2] = 0.0", SURFACES),
    of_host("sweep: upside down", CONSISTENCY, "rays *= np.array([1.0, -1.0, -1.0]) / np.linalg.norm(rays, axis=1",
            "rays *= np.array([1.0, 1.0, -1.0]) / np.linalg.norm(rays, axis=1", SURFACES),
    of_host("sweep: photographs that do not fit", "scenes/extent/swept.py", "not photographs.tell_depths", "not photographs.can_tell",
            "scenes/test_swept.py::test_photographs_that_do_not_fit_are_not_believed"),
    of_host("sweep: whose places they are", "scenes/extent/swept.py", "seen[index] =", "seen[number] =",
            "scenes/test_swept.py::test_of_many_photographs_some_are_looked_at"),
    of_host("sweep: never asked", "training/coarse.py", "lambda: extent_by_sweep(scene)", "lambda: None",
            "scenes/test_swept.py::test_where_they_tell_nothing_is_trained_before"),
    of_host("sweep: the far end is tried alone", CONSISTENCY, "found[DEPTHS:].max(axis=0)", "found[DEPTHS]",
            "scenes/test_given_depths.py::test_bounds_that_hold_what_photographs_show_are_used"),
    of_host("photographs: alike is the same", DIAGNOSTICS, "if moved and np.array_equal(other.image, view.image):", "if moved:", FROZEN),
    of_host("photographs: at any poses", DIAGNOSTICS, "if moved and np.", "if np.", FROZEN),
    of_host("photographs: one colour is the same", DIAGNOSTICS, " if not look.is_of_one_colour}\n", "}\n", FROZEN),
    of_host("photographs: dark", DIAGNOSTICS, "DARK = 16", "DARK = 17", NEARLY_BLACK),
    of_host("photographs: some are dark", DIAGNOSTICS, "> 0.5 * len(scene.views)", "> 0.3 * len(scene.views)", NEARLY_BLACK),
    of_host("photographs: still to the bit", DIAGNOSTICS, "\nSTILL = 3.0", "\nSTILL = 1.0", STILL),
    of_host("photographs: nine tell what is still", DIAGNOSTICS, "ENOUGH_STILL = 10", "ENOUGH_STILL = 9", STILL),
    of_host("photographs: still as any, where all look the same way", DIAGNOSTICS, "< SAME_WAY", "< 2.0",
            "inspection/test_inspection.py::test_where_cameras_look_the_same_way_less_is_still"),
    of_host("photographs: a sky is still", DIAGNOSTICS, "if not still[[", "if 0 and not still[[", STILL),
    of_host("photographs: no white is still", DIAGNOSTICS, "if not still[[", "if 1 or not still[[", STILL),
    of_host("photographs: a background is still", DIAGNOSTICS, "still.mean() > BACKGROUND", "False",
            "inspection/test_inspection.py::test_a_background_of_one_colour_is_not_said"),
    of_host("photographs: bars are a background", DIAGNOSTICS, "        and not bars[still].all()\n", "", STILL),
    of_host("photographs: dark ones are the same", DIAGNOSTICS, " if look.brightest > DARK})", "})",
            "inspection/test_inspection.py::test_dark_photographs_are_not_the_same_in_all"),
    of_host("photographs: masked ones are still", DIAGNOSTICS, "if mask is None else mask[every]", "if True else mask[every]", NOT_SEEN),
    of_host("photographs: transparent ones are still", DIAGNOSTICS, "counts &= sample[..., 3] > 0", "counts &= sample[..., 3] >= 0", NOT_SEEN),
    of_host("depths: instant-ngp's in millimetres", "scenes/formats/transforms.py", "depth_unit = unit_of_ngp", "depth_unit = unit",
            "scenes/test_depths.py::test_depth_is_read_as_instant_ngp_names_it"),
    of_host("depths: depth_path comes first", "scenes/formats/transforms.py", "if ngp_depth and not entry.depth_file_path:", "if entry.depth_path:",
            "scenes/test_depths.py::test_depth_is_read_as_instant_ngp_names_it"),
    of_host("masks: half is little", MASKED, "HALF = 0.5", "HALF = 0.7", LEFT),
    of_host("masks: a third is enough", MASKED, "focus > HALF or (share >= HALF and (", "focus > HALF or (share >= 0.3 and (", LEFT),
    of_host("masks: any focus", MASKED, "    if focus.guessed:\n        return 1.0\n", "", LEFT),
    of_host("masks: the focus upside down", MASKED, "camera.cx - camera.fx * x / z", "camera.cx + 2.0 + camera.fx * x / z", LEFT),
    of_host("masks: any of a block", "scenes/images/masks.py", "blocks.all(axis=(1, 3))", "blocks.any(axis=(1, 3))", BLOCKS),
    of_host("masks: transparent counts", "scenes/images/masks.py", "        white &= image[..., 3] > 127\n", "        pass\n",
            "scenes/test_masks.py::test_every_kind_of_image_is_a_mask"),
    # parts, other units, what photographs and files tell of poses, lenses and masks
    of_host("parts: of some that do not fit", CONVENTIONS, "other.is_better(given) and bool(np.mean(each) >= NEARLY_EVERY)", "other.is_better(given)", PROVED),
    of_host("parts: whatever the others do", CONVENTIONS, "agreement.fits and bool(np.mean(agreement.gain > NOTABLY) >= ALMOST_ALL)", "agreement.fits", PROVED),
    of_host("upside down: no line", FOCUS, "if np.mean(np.abs(along) > 0.5) >= SPLIT:", "if False:", FEWER),
    of_host("upside down: drones, too", FOCUS, " and np.linalg.norm(axes.mean(axis=0)) < ONE_WAY", "", DRONE),
    of_host("doubts: distortion always fits", DOUBTS, "if photographs.distorted and _undistorted(photographs):", "if False:", BENT),
    of_host("doubts: some never unfit", DOUBTS, "    if gain[~unfit].mean() < OTHERS:\n", "    if True:\n", UNFIT),
    of_host("doubts: of testing none", DOUBTS, "    if unfit.sum() < max(FEWEST_UNFIT, MOST_OTHERS * len(unfit)):\n", "    if True:\n", TESTING),
    of_host("doubts: mirrored the other way", DOUBTS, "photographs.mirrored(across=across)", "photographs.mirrored(across=not across)", MIRROR),
    of_host("masks: gray photographs", "scenes/images/mask_values.py", " and _coloured(image) > COLOURED", "", MATTES),
    of_host("masks: soft edges are classes", "scenes/images/mask_values.py", "FLAT = 0.5", "FLAT = 0.0", MATTES),
    of_host("masks: idle are none", MASKED, "if len(given) < SEVERAL or any(", "if True or any(", "scenes/test_masks.py::test_masks_that_ignore_nothing_are_told"),
    of_host("lens: any zoom is one", FRAME, "ZOOMED = 0.08", "ZOOMED = 8.0", "scenes/test_lens.py::test_photographs_of_several_focal_lengths_have_no_one_lens"),
    of_host("lens: kinds of focal lengths are one", FRAME, "kinds.setdefault(is_of_film, [])", "kinds.setdefault(True, [])",
            "scenes/test_lens.py::test_focal_lengths_for_film_are_no_others_than_the_lens_s_own"),
    of_host("poses: others at one are copies", "scenes/formats/assemble.py", "if np.array_equal(o.image, view.image)), None)", "), None)",
            "scenes/test_given_twice.py::test_different_photographs_at_one_pose_are_named"),
    of_host("metashape: shutters that do not roll", "scenes/formats/metashape.py", 'not in ("", "0", "false", "none", "disabled")', 'not in ("", "0")',
            "scenes/test_metashape.py::test_metashape_rolling_shutters_are_named"),
    of_host("degrees: along one axis", DIAGNOSTICS, "both = across.min() > ASKEW * across.max()", "both = True", TRACKS),
    of_host("degrees: in metres", DIAGNOSTICS, "HIGHER * across.max() < up < HIGHEST", "0.0 <= up < HIGHEST", TRACKS),
    of_host("units: of any spread", DIAGNOSTICS, "LIKELY = 1.5", "LIKELY = 1e9", TWO_PLACES),
    of_host("units: how far does not count", DIAGNOSTICS, "if is_unit and times / ALONG <= further <= ALONG * times else", "if is_unit else", TWO_PLACES),
    of_host("moved: by the name alone", "scenes/files.py", "self._least = 1 if alone else 2", "self._least = 1", OF_ANOTHER),
    of_host("moved: photographs are masks", "scenes/files.py", "path not in self._taken and ", "", OF_ANOTHER),
    of_host("moved: one file of two paths", "scenes/files.py", "self._texts.get(path, text) == text", "True", OF_ANOTHER),
    # cameras and scenes made by hand
    of_host("camera: any matrix", "scenes/cameras/camera.py", '        require_rigid("Camera.c2w", self.c2w)\n', "", NO_RAYS),
    of_host("camera: complex", "scenes/cameras/camera.py", 'self.c2w.dtype.kind not in "fiu"', "False", NO_RAYS),
    of_host("scene: points of nothing", "scenes/scene.py", "            or not np.isfinite(points).all()\n", "", BY_HAND),
    of_host("scene: any box", "scenes/scene.py", "(np.abs(box) <= MAX_COORDINATE).all()", "np.isfinite(box).all()", BY_HAND),
]  # fmt: skip
