"""Mutants of the host's code that writes files for other programs, and pictures of all outputs."""

from mutant import of_host

SPZ, ATLAS, DECIMATION, HOLES, PINHOLE, FIRST = (
    f"exporting/{name}.py"
    for name in ("spz", "atlas", "decimation", "holes", "pinhole", "first_view")
)
KEPT, PANELS, STUDIO, NORMALS = (
    "exporting/visibility_file.py",
    "media/panels.py",
    "media/nerfstudio_path.py",
    "rendering/normals.py",
)
READ = "exporting/test_spz.py::test_what_is_read_is_what_was_written"
FAR = "exporting/test_spz.py::test_far_splats_do_not_cost_the_near_ones_their_place"
TEXELS = "exporting/test_atlas.py::test_texels_show_their_places"
LARGEST = "exporting/test_atlas.py::test_a_texture_stays_within_the_largest"
FEWER = "exporting/test_decimation.py::test_a_ball_of_fewer_faces_stays_a_closed_ball"
LONG_NAMES = "project/test_writing.py::test_names_as_long_as_they_may_be_are_written"
BORDER = "exporting/test_decimation.py::test_a_plane_keeps_its_border_and_a_crease"
LEFT = "exporting/test_decimation.py::test_what_cannot_be_contracted_is_left"
CLOSED = "exporting/test_holes.py::test_a_narrow_hole_is_closed_and_a_wide_one_is_told"
PIXEL = "exporting/test_pinhole.py::test_a_pixel_shows_what_lies_in_its_direction"
INSIDE = "exporting/test_first_view.py::test_it_is_no_camera_inside_of_something_or_that_looks_away"
BEFORE = "exporting/test_first_view.py::test_points_are_seen_in_the_picture_and_before_its_depth"
ANOTHER = "cli/test_export.py::test_of_another_field_the_visibility_is_computed_again"
STILLS = "cli/test_render_command.py::test_stills_replace_nothing_but_stills"
OVER = "media/test_panels.py::test_transparent_pictures_over_the_background_are_the_rendering"
OF_BALL = "media/test_panels.py::test_normals_are_those_of_the_ball_in_the_cameras_axes"
STUDIO_FRAMES = (
    "media/test_nerfstudio_path.py::test_frames_are_the_cameras_in_the_scenes_coordinates"
)

MUTANTS = [
    # spz.py
    of_host("spz: colours by the harmonic", SPZ, "COLOUR_STEP = 0.15", "COLOUR_STEP = 0.28", READ),
    of_host("spz: scales of e^-9", SPZ, "SMALLEST_SCALE, SCALE_STEPS = -10.0", "SMALLEST_SCALE, SCALE_STEPS = -9.0", READ),
    of_host("spz: w negative", SPZ, "np.where(chosen[:, :1] < 0.0, -1.0, 1.0) * ", "", READ),
    of_host("spz: w as it is", SPZ, "np.abs(same[:, 0]).argmax(axis=0)", "np.zeros(len(w), int)", READ),
    of_host("spz: centres are not turned", SPZ, ".astype(np.float64) @ turn.T\n", ".astype(np.float64)\n", READ),
    of_host("spz: splats are not turned", SPZ, "turned(splats.rotations[kept].astype(np.float64), turn)",
            "splats.rotations[kept].astype(np.float64)", READ),
    of_host("spz: as far as splats lie", SPZ, "kept = reach * 2.0**least_bits <= LARGEST", "kept = reach >= 0.0", FAR),
    # atlas.py
    of_host("atlas: half a texel aside", ATLAS, "p = texels + 0.5 - a[owner]", "p = texels + 3.0 - a[owner]", TEXELS),
    of_host("atlas: without margins", ATLAS, "    for _ in range(MARGIN + 1):\n        _spread(texture, filled)\n", "", TEXELS),
    of_host("atlas: charts of faces between texels", ATLAS, "missing = ~filled[texels[:, 1], texels[:, 0]]",
            "missing = np.zeros(len(texels), bool)", TEXELS),
    of_host("atlas: as large as it gets", ATLAS, "if max(width, height) <= largest or", "if True or", LARGEST),
    # decimation.py
    of_host("decimation: borders as edges", DECIMATION, "BORDER = 10.0", "BORDER = 0.0", BORDER),
    of_host("decimation: middles of edges", DECIMATION, "TOWARDS_MIDDLE = 1e-3", "TOWARDS_MIDDLE = 1e3", FEWER),
    of_host("decimation: slivers hold on", DECIMATION, "SLIVER = 0.02", "SLIVER = -1.0", FEWER),
    of_host("decimation: to nothing", DECIMATION, " & (n_around > edges.n_faces[chosen])", "", LEFT),
    # holes.py, pinhole.py, first_view.py
    of_host("holes: fans inside out", HOLES, "[np.roll(border, -1), border, middle]", "[border, np.roll(border, -1), middle]",
            CLOSED),
    # writing.py, filming.py
    of_host("writing: through a link", "writing.py", "            temporary.unlink(missing_ok=True)  # a link, or of a process that had this number\n            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL", "            flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC",
            "project/test_writing.py::test_a_link_in_place_of_a_temporary_file_is_not_followed"),
    of_host("writing: the end of a name alone", "writing.py", "{zlib.crc32(whole):08x}-", "", LONG_NAMES),
    of_host("writing: long names are added to", "writing.py", "if len(whole) > LONGEST_NAME:", "if False:", LONG_NAMES),
    of_host("writing: the last error is told", "writing.py", "suppress(OSError)", "suppress(KeyError)",
            "project/test_writing.py::test_what_cannot_be_removed_hides_no_error"),
    of_host("stills: wherever names lead", "media/filming.py", " or Path(name).name != name", "",
            "media/test_filming.py::test_stills_stay_in_their_folder"),
    of_host("stills: of anything", "media/filming.py", " and mark not in beginning(path, MARKED)", " and False", STILLS),
    of_host("stills: through links that lead nowhere", "media/filming.py", "os.path.lexists(path)", "path.exists()", STILLS),
    of_host("crop: of nothing", "rendering/field.py", "if free.occupied_range() is None", "if False",
            "cli/test_render_command.py::test_a_crop_that_holds_nothing_is_refused"),
    of_host("cameras: for testing as they are", "exporting/cameras.py", "\"val\": test, \"test\": test}", "\"test\": test}",
            "cli/test_export.py::test_a_scene_that_is_all_trained_on_is_exported_so"),
    of_host("pinhole: a pixel aside", PINHOLE, "(camera.cx, camera.cy) - 0.5", "(camera.cx, camera.cy) + 1.5", PIXEL),
    of_host("pinhole: masks as they are", PINHOLE, "_interpolated(both.astype(np.float32)[..., None], low, shares)[..., 0]",
            "both.astype(np.float32)", PIXEL),
    of_host("first view: near points count more", FIRST, "points[np.unique(cells, axis=0, return_index=True)[1]]", "points",
            INSIDE),
    of_host("first view: through walls", FIRST, "BEHIND = 1.05", "BEHIND = 1e9", BEFORE),
    # visibility_file.py
    of_host("kept: of any field", KEPT, "digest.update(digest_of(header, field_tensors(field)).encode())", "pass", ANOTHER),
    of_host("kept: of any masks", KEPT, "np.packbits(view.mask).tobytes()", "b\"\"", ANOTHER),
    of_host("kept: of any cameras", KEPT, "digest.update(f\"{name} {np.asarray(value).tolist()}\".encode())", "pass", ANOTHER),
    # panels.py, normals.py, nerfstudio_path.py
    of_host("panels: the background stays", PANELS, "(shown - behind) / np", "shown / np", OVER),
    of_host("normals: inward", NORMALS, "falling[:, axis] = before - after", "falling[:, axis] = after - before", OF_BALL),
    of_host("normals: in the scene's axes", NORMALS, " @ camera.c2w[:, :3]\n", "\n", OF_BALL),
    of_host("nerfstudio: as large as it is there", STUDIO, "poses[:, :, 3] / read.scale", "poses[:, :, 3]", STUDIO_FRAMES),
    of_host("nerfstudio: turned the other way", STUDIO, "rotation.T @ poses[:, :, :3]", "rotation @ poses[:, :, :3]",
            STUDIO_FRAMES),
]  # fmt: skip
