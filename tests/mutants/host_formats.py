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
SCALED = "scenes/test_lens.py::test_a_lens_is_scaled_to_resized_photographs"
NEARLY = "scenes/test_lens.py::test_photographs_of_nearly_the_stated_size_are_not_resized_ones"
NOT_RESIZED = "scenes/test_lens.py::test_other_photographs_are_no_resized_ones"
LENS = "scenes/cameras/lens.py"
LENSES, BROWN = "scenes/cameras/foreign.py", "scenes/cameras/brown.py"
RESAMPLING = "scenes/images/resampling.py"
POLYCAM, RECORD3D, METASHAPE, REALITY, REDUCED = (
    f"scenes/formats/{name}.py"
    for name in ("polycam", "record3d", "metashape", "reality", "reduced")
)
CONVENTIONS = "scenes/extent/conventions.py"

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
        "(adjusted or calibrations or [sensor])[-1]",
        "(calibrations or [sensor])[0]",
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
]
