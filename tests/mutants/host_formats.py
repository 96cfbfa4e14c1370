"""Mutants of readers of other programs' captures, and of lenses that are none of OpenCV's."""

from mutant import of_host

PROGRAMS = "scenes/test_programs.py::test_"
METASHAPE_TESTS = "scenes/test_metashape.py::test_"
FOREIGN = "scenes/test_foreign.py::test_"
SAME = f"{PROGRAMS}the_scene_is_that_of_transforms_json"
COLMAP = f"{FOREIGN}positions_are_those_of_colmap"
SHOWN = f"{FOREIGN}photographs_show_what_the_lens_saw"
MASKS = f"{FOREIGN}masks_and_alpha_and_reduction_follow"
NEAREST = f"{FOREIGN}the_nearest_lens_is_off_by_what_it_says"
METASHAPE_LENS = f"{METASHAPE_TESTS}metashape_tangential_is_the_other_way_round"
TRANSFORMS = f"{METASHAPE_TESTS}metashape_transforms_lead_to_the_projects_coordinates"
GEOCENTRIC = f"{METASHAPE_TESTS}metashape_coordinates_are_geocentric_near_the_ellipsoid"
APPLIED = "scenes/test_points.py::test_points_are_turned_as_the_cameras_of_their_model_were"
EARTH = f"{METASHAPE_TESTS}metashape_geocentric_coordinates_are_turned_up"
REALITY_LENS = f"{PROGRAMS}reality_lens"
USED = "scenes/test_reduced.py::test_reduced_photographs_are_used"
NOT_USED = "scenes/test_reduced.py::test_others_are_not_used_and_said"

IMAGES = "scenes/test_frame_images.py::test_"
NAMED = f"{IMAGES}photographs_are_found_by_their_names"
SCALED = "scenes/test_lens.py::test_a_lens_is_scaled_to_resized_photographs"
NEARLY = "scenes/test_lens.py::test_photographs_of_nearly_the_stated_size_are_not_resized_ones"
NOT_RESIZED = "scenes/test_lens.py::test_other_photographs_are_no_resized_ones"

LENS, FRAME_IMAGES = "scenes/cameras/lens.py", "scenes/formats/frame_images.py"
LENSES, BROWN = "scenes/cameras/foreign.py", "scenes/cameras/brown.py"
RESAMPLING = "scenes/images/resampling.py"
POLYCAM, RECORD3D, METASHAPE, REALITY, FOUND, REDUCED = (
    f"scenes/formats/{name}.py"
    for name in ("polycam", "record3d", "metashape", "reality", "found_photographs", "reduced")
)

LEFT, UNNAMED, LISTS, MODELS, CONTENTS, TRANSFORMS_FILE = (
    f"scenes/formats/{name}.py"
    for name in (
        *("left_over", "unnamed_photographs", "split_lists", "colmap_models", "contents"),
        "transforms",
    )
)
CONVENTIONS = "scenes/extent/conventions.py"
LEFT_TESTS = "scenes/test_left_over.py::test_"
LISTS_TESTS = "scenes/test_split_lists.py::test_"
MODELS_TESTS = "scenes/test_colmap_models.py::test_"
FOLDERS = "scenes/test_contents.py::test_what_a_folder_without_a_scene_holds"

MUTANTS = [
    of_host("FOV: half of the tangent", LENSES, "2.0 * r * math.tan", "r * math.tan", COLMAP),
    of_host(
        "thin prism: its other axis",
        LENSES,
        "2.0 * x * x) + s1 * r2",
        "2.0 * x * x) + s2 * r2",
        COLMAP,
    ),
    of_host("division: the other sign", LENSES, "1.0 - 4.0 * k", "1.0 + 4.0 * k", COLMAP),
    of_host("EUCM: no alpha", LENSES, "+ (1.0 - alpha)", "+ 1.0", COLMAP),
    of_host(
        "Brown: tangential of OpenCV",
        LENSES,
        "grown * (p1 * (r2 + 2.0 * x * x) + 2.0 * p2",
        "grown * (p2 * (r2 + 2.0 * x * x) + 2.0 * p1",
        f"{FOREIGN}positions_are_those_of_metashape",
    ),
    of_host(
        "skew of x",
        LENSES,
        "u + self.skew * v",
        "u + self.skew * u",
        f"{FOREIGN}positions_are_those_of_metashape",
    ),
    of_host(
        "nearest: no tangential terms",
        LENSES,
        "tangential=lambda p: (p[5], p[4])",
        "tangential=lambda p: (p[4], p[5])",
        NEAREST,
    ),
    of_host(
        "nearest: the corners are not looked at",
        LENSES,
        "phi = np.concatenate([phi, corners])",
        "pass",
        NEAREST,
    ),
    of_host(
        "nearest: focal length of a fisheye",
        LENSES,
        "plane.fx * s, plane.fy * s",
        "plane.fx, plane.fy",
        NEAREST,
    ),
    of_host(
        "undistorted: half a pixel", RESAMPLING, "np.clip(at - 0.5, 0.0", "np.clip(at, 0.0", SHOWN
    ),
    of_host(
        "undistorted: moved the other way",
        RESAMPLING,
        "lens.project(rays)) - knots",
        "lens.project(rays)) - knots - 1.0",
        SHOWN,
    ),
    of_host(
        "undistorted: weights of a quarter",
        RESAMPLING,
        "t * (0.5 + t * (2.0 - 1.5 * t))",
        "t * (0.5 + t * (1.0 - 1.5 * t))",
        SHOWN,
    ),
    of_host(
        "undistorted: edges count",
        RESAMPLING,
        "inside = (u >= 0.0) & (u < width)",
        "inside = (u >= -99.0)",
        SHOWN,
    ),
    of_host(
        "undistorted: masks stay",
        RESAMPLING,
        "inside &= counts[row",
        "inside &= True | counts[row",
        MASKS,
    ),
    of_host(
        "undistorted: plane of the whole",
        "scenes/formats/frame.py",
        "reduced.fx / whole.fx",
        "1.0",
        MASKS,
    ),
    of_host(
        "Polycam: depth in metres",
        POLYCAM,
        "MILLIMETRE = 1e-3",
        "MILLIMETRE = 1.0",
        f"{PROGRAMS}polycam_depth_is_in_millimetres",
    ),
    of_host("Polycam: transposed", POLYCAM, 't_{i}{j}")', 't_{min(i, j)}{max(i, j)}")', SAME),
    of_host("Record3D: w first", RECORD3D, "x, y, z, w = pose[:4]", "w, x, y, z = pose[:4]", SAME),
    of_host(
        "Record3D: K by rows",
        RECORD3D,
        "centre = (k[2], k[5]) if by_rows else (k[6], k[7])",
        "centre = (k[2], k[5])",
        SAME,
    ),
    of_host(
        "another size: not scaled",
        LENS,
        "across, along = width / stated[0], height / stated[1]",
        "across = along = 1.0",
        f"{PROGRAMS}record3d_lens_is_scaled_to_its_photographs",
    ),
    of_host("another size: by one factor", LENS, '"fl_y": along', '"fl_y": across', SCALED),
    of_host(
        "another size: of any shape",
        LENS,
        "abs(width * h - height * w) > max(w, h)",
        "False",
        NOT_RESIZED,
    ),
    of_host(
        "another size: of the lens already",
        LENS,
        "abs(centre - stated / 2) >= abs(centre - size / 2)",
        "False",
        NOT_RESIZED,
    ),
    of_host("another size: by a pixel", LENS, "MIN_RESIZED = 1.015", "MIN_RESIZED = 1.01", NEARLY),
    of_host("another size: by much", LENS, "MIN_RESIZED = 1.015", "MIN_RESIZED = 1.02", NEARLY),
    of_host("names: no normal form", FOUND, 'unicodedata.normalize("NFC", name)', "name", NAMED),
    of_host(
        "names: of any folder",
        FRAME_IMAGES,
        "self._whole.setdefault(parts, [])",
        "self._whole.setdefault(parts[-1:], [])",
        f"{IMAGES}photographs_of_other_names_are_mentioned",
    ),
    of_host(
        "names: taken twice",
        FRAME_IMAGES,
        "if owner != names[index]:",
        "if False:",
        f"{IMAGES}what_is_not_certain_is_refused",
    ),
    of_host(
        "names: of another frame",
        FRAME_IMAGES,
        "[*found.values(), *taken]",
        "taken",
        f"{IMAGES}what_another_name_leads_to_is_not_taken",
    ),
    of_host(
        "names: of another file",
        FRAME_IMAGES,
        "[*found.values(), *taken]",
        "found.values()",
        f"{IMAGES}photographs_for_training_are_not_found_for_testing",
    ),
    of_host(
        "names: with another ending anywhere",
        FRAME_IMAGES,
        "if converted or n > 1",
        "if True",
        f"{IMAGES}photographs_of_other_names_are_mentioned",
    ),
    of_host(
        "names: of renderings",
        FRAME_IMAGES,
        "if RENDERINGS.fullmatch(parts[start - 1]):",
        "if False:",
        f"{IMAGES}images_that_are_named_after_photographs_are_none",
    ),
    of_host(
        "names: of masks and the like",
        FOUND,
        "|{OTHER_IMAGES.pattern}",
        "",
        f"{IMAGES}images_that_are_named_after_photographs_are_none",
    ),
    of_host(
        "names: a folder of any name",
        FRAME_IMAGES,
        "len(self._parts_of(path)) > len(_parts(name)) and",
        "False and",
        f"{IMAGES}photographs_of_a_folder_of_any_name_are_warned_of",
    ),
    of_host(
        "names: a folder of photographs",
        FRAME_IMAGES,
        " and not OWN.fullmatch(top)",
        "",
        NAMED,
    ),
    of_host(
        "names: always of another format",
        FRAME_IMAGES,
        "return converted or",
        "return True or",
        f"{IMAGES}another_format_is_not_taken_where_others_have_the_files",
    ),
    of_host(
        "names: a few from elsewhere",
        FRAME_IMAGES,
        "in () if found else dict",
        "in dict",
        f"{IMAGES}photographs_elsewhere_are_not_taken_for_a_few_that_are_missing",
    ),
    of_host(
        "names: a link out",
        FRAME_IMAGES,
        "resolve_inside(base, path.relative_to(base).as_posix(), field=field(index))",
        "pass",
        f"{IMAGES}what_is_not_certain_is_refused",
    ),
    of_host(
        "photographs: those of macOS",
        "scenes/files.py",
        'and not name.startswith(".")',
        "",
        "scenes/test_llff.py::test_photographs_are_found_and_those_of_macos_are_none",
    ),
    of_host("Metashape: axes of OpenGL", METASHAPE, "pose * [1.0, -1.0, -1.0, 1.0]", "pose", SAME),
    of_host(
        "Metashape: cx from the edge",
        METASHAPE,
        '0.5 * width + given.get("cx", 0.0)',
        'given.get("cx", 0.0)',
        SAME,
    ),
    of_host(
        "Metashape: b1 of both",
        METASHAPE,
        'given.get("b1", 0.0), given["f"]',
        'given.get("b1", 0.0), given["f"] + given.get("b1", 0.0)',
        SAME,
    ),
    of_host(
        "Metashape: the initial calibration",
        METASHAPE,
        "(adjusted or calibrations)[-1]",
        "calibrations[0]",
        SAME,
    ),
    of_host("Metashape: no scale", METASHAPE, "to.scale * to.rotation", "to.rotation", TRANSFORMS),
    of_host(
        "Metashape: cameras are not turned",
        METASHAPE,
        "[to.rotation @ pose[:, :3], position",
        "[pose[:, :3], position",
        TRANSFORMS,
    ),
    of_host(
        "Metashape: far below the ground",
        METASHAPE,
        "GROUND = (-2e3, 2e4)",
        "GROUND = (-1e5, 2e4)",
        GEOCENTRIC,
    ),
    of_host(
        "Metashape: far above the ground",
        METASHAPE,
        "GROUND = (-2e3, 2e4)",
        "GROUND = (-2e3, 1e5)",
        GEOCENTRIC,
    ),
    of_host("Metashape: local on the earth", METASHAPE, '"LOCAL_CS"', '"PROJCS"', GEOCENTRIC),
    of_host(
        "applied transform: not of points",
        "scenes/formats/colmap.py",
        'return replace(points, positions=positions), ""',
        'return points, ""',
        APPLIED,
    ),
    of_host(
        "applied transform: turned only",
        "scenes/formats/colmap.py",
        "moved[:, :, -1] += applied[:, 3]",
        "pass",
        APPLIED,
    ),
    of_host("Metashape: a round earth", METASHAPE, "middle / AXES**2", "middle", EARTH),
    of_host(
        "Brown: p1 and p2 as OpenCV",
        BROWN,
        '"p1": p2, "p2": p1',
        '"p1": p1, "p2": p2',
        METASHAPE_LENS,
    ),
    of_host(
        "Brown: k4 forgotten", BROWN, "any((k4, p3, p4, skew))", "any((p3, p4, skew))", REALITY_LENS
    ),
    of_host(
        "RealityCapture: heading counterclockwise",
        REALITY,
        "_about(2, -heading)",
        "_about(2, heading)",
        f"{PROGRAMS}reality_angles_are_those_of_its_own_matrix",
    ),
    of_host(
        "RealityCapture: by the width",
        REALITY,
        "longer = max(size)",
        "longer = size[0]",
        f"{PROGRAMS}reality_focal_length_is_by_the_longer_side",
    ),
    of_host("RealityCapture: px in pixels", REALITY, 'row["px"] * longer', 'row["px"]', SAME),
    of_host(
        "reduced: any size",
        REDUCED,
        "there[:2] != (height / downscale, width / downscale)",
        "False",
        NOT_USED,
    ),
    of_host("reduced: whatever it shows", REDUCED, "ALIKE = 20.0", "ALIKE = 300.0", NOT_USED),
    of_host(
        "reduced: and once more",
        "scenes/formats/assemble.py",
        "downscale if frame.reduced is None else 1",
        "downscale",
        USED,
    ),
    of_host(
        "RealityCapture: a comma is a comma",
        REALITY,
        'word = word.replace(",", ".")',
        "pass",
        f"{PROGRAMS}reality_decimal_commas",
    ),
    of_host(
        "left over: masks that are used, too",
        LEFT,
        "and path not in inside",
        "",
        f"{LEFT_TESTS}what_is_no_folder_of_masks_is_not_said",
    ),
    of_host(
        "left over: masks in the scene's folder only",
        LEFT,
        "while folder in parent.parents",
        "while False",
        f"{LEFT_TESTS}masks_may_lie_beside_the_folder_of_photographs",
    ),
    of_host(
        "left over: the first of several clouds",
        LEFT,
        "len(files) != 1",
        "not files",
        f"{LEFT_TESTS}a_single_ply_is_the_scene_s_points",
    ),
    of_host(
        "left over: a link out of the folder",
        LEFT,
        "resolve_inside(folder, name, field=name)",
        "folder / name",
        f"{LEFT_TESTS}points_that_cannot_be_read_are_said",
    ),
    of_host(
        "unnamed: always a note",
        UNNAMED,
        "> UNPOSED * len(own)",
        "> len(own)",
        f"{LEFT_TESTS}photographs_that_transforms_json_does_not_name_are_said",
    ),
    of_host(
        "unnamed: what is called after a photograph, too",
        UNNAMED,
        "or stems.get(path.parent, set()).isdisjoint(_called_after(path.stem))",
        "or True",
        f"{LEFT_TESTS}photographs_that_transforms_json_does_not_name_are_said",
    ),
    of_host(
        "unnamed: any model",
        TRANSFORMS_FILE,
        "n > len(frames)",
        "n > 4",
        f"{LEFT_TESTS}a_model_of_more_photographs_is_named",
    ),
    of_host(
        "lists: a short name of two",
        LISTS,
        "if len(of) == 1",
        "if of",
        f"{LISTS_TESTS}a_short_name_of_two_photographs_is_that_of_none",
    ),
    of_host(
        "lists: any share of the lines",
        LISTS,
        "BELIEVED = 0.9",
        "BELIEVED = 0.8",
        f"{LISTS_TESTS}a_text_that_names_some_photographs_only_is_no_list",
    ),
    of_host(
        "lists: of all places",
        LISTS,
        "        if splits:\n            aside",
        "        if False:\n            aside",
        f"{LISTS_TESTS}lists_of_two_places_or_programs_are_not_combined",
    ),
    of_host(
        "left over: a warning of points that were tried",
        CONVENTIONS,
        "if points.tried:",
        "if False:",
        "scenes/test_conventions.py::test_points_that_fit_in_no_way_are_left_out",
    ),
    of_host(
        "masks: one of its name in another folder",
        "scenes/images/masks.py",
        "folder = str(path).removesuffix(path.name)",
        "folder = 'a/'",
        "scenes/test_masks.py::test_masks_among_images_are_told_by_their_names_alone",
    ),
    of_host(
        "lists: over those of transforms.json",
        TRANSFORMS_FILE,
        "withhold is None and not any(splits.values())",
        "withhold is None",
        f"{LISTS_TESTS}lists_beside_transforms_json",
    ),
    of_host(
        "lists: whatever is withheld",
        TRANSFORMS_FILE,
        "withhold is None and not any(splits.values())",
        "not any(splits.values())",
        f"{LISTS_TESTS}lists_beside_transforms_json",
    ),
    of_host(
        "models: photographs of the folder above",
        MODELS,
        " or (folder == own and _has_photographs(folder))",
        "",
        f"{MODELS_TESTS}photographs_in_the_folder_itself_are_not_those_of_the_one_above",
    ),
    of_host(
        "models: a picture beside a model",
        MODELS,
        "(folder == own and _has_photographs(folder))",
        "_has_photographs(folder)",
        f"{MODELS_TESTS}photographs_in_the_folder_itself_are_not_those_of_the_one_above",
    ),
    of_host(
        "models: as text, always",
        MODELS,
        "(n or 0) < CLEARLY_SMALLER * (_listed(text) or 0)",
        "True",
        f"{MODELS_TESTS}a_text_that_only_states_more_images_is_not_read",
    ),
    of_host(
        "models: as text, if a few more",
        MODELS,
        "CLEARLY_SMALLER = 0.8",
        "CLEARLY_SMALLER = 1.0",
        f"{MODELS_TESTS}a_text_of_a_few_images_more_is_not_read",
    ),
    of_host(
        "models: a copy is out of date",
        MODELS,
        "if listed == n:",
        "if False:",
        f"{MODELS_TESTS}a_copy_of_a_model_in_the_other_form_needs_no_word",
    ),
    of_host(
        "contents: the folder of the fewest",
        CONTENTS,
        "largest = max(deeper",
        "largest = min(deeper",
        FOLDERS,
    ),
    of_host(
        "contents: pictures on top, however few",
        CONTENTS,
        "and len(more) > n",
        "and False",
        FOLDERS,
    ),
    of_host(
        "contents: any folder in a scene's is its images",
        CONTENTS,
        "if IMAGES.fullmatch(folder.name) and",
        "if",
        "scenes/test_contents.py::test_photographs_of_a_scene_lead_to_it",
    ),
]
