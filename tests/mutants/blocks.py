"""Mutants of scenes in blocks: steps that are cut, cells in order, and the cutting itself."""

from mutant import Mutant, of_host

COPIES = "rendering/test_composite.py::test_copies_of_a_field_are_the_field"
PACKED, SCALAR = f"{COPIES}[True]", f"{COPIES}[False]"
IN_ITS_CELL = "rendering/test_composite.py::test_each_field_is_seen_in_its_cell_only"
ONE_CELL = "rendering/test_composite.py::test_every_point_of_a_ray_is_in_one_cell"
FILL = "blocks/test_cut.py::test_every_place_is_in_one_cell"
WHERE_THEY_LOOK = "blocks/test_cut.py::test_photographs_train_the_blocks_that_they_see"
SEEN = "blocks/test_cut.py::test_depth_and_points_tell_what_is_seen"
OF_PART = "blocks/test_cut.py::test_the_scene_of_a_block_has_its_photographs_and_box"
ROOMS = "scenes/test_building.py::test_a_building_is_the_room_again_in_other_places_and_colours"
BOX = "blocks/test_cut.py::test_what_fills_a_box"
TRAINING = "blocks/test_train_blocks.py::"
LINKED = f"{TRAINING}test_links_and_pipes_are_not_written_to"
STORED = f"{TRAINING}test_stored_options_are_no_others_than_given_ones"
REFUSED = f"{TRAINING}test_blocks_that_are_not_those_of_a_cut_are_refused"
CLIPPED, COMPOSITE, CUT = "sampling/clipped.py", "rendering/composite.py", "blocks/cut.py"

MUTANTS = [
    Mutant("in blocks: whole steps in packs", CLIPPED, "store(pack.dt, max(length, none));", "", PACKED),
    Mutant("in blocks: the sample moves", CLIPPED, "whole[0] + ray.offset * (whole[1] - length)", "wp.max(whole[0], ends[0])", SCALAR),
    Mutant("in blocks: only at the beginning", CLIPPED, "whole[1] - before - behind", "whole[1] - before", SCALAR),
    of_host("in blocks: light of the last part only", COMPOSITE, "light[rays] *= 1.0 - part.opacity", "light[rays] = 1.0 - part.opacity",
            PACKED),
    of_host("in blocks: behind first", COMPOSITE, "nearest = order[number]", "nearest = order[-1 - number]", PACKED),
    of_host("in blocks: upper faces belong too", COMPOSITE, "np.where(origin < high, np.inf, -np.inf)",
            "np.where(origin <= high, np.inf, -np.inf)", ONE_CELL),
    of_host("in blocks: cores end with the box", CUT, "cell = np.where(core == root, [[-np.inf], [np.inf]], core)", "cell = core", FILL),
    of_host("in blocks: by places, not by photographs", CUT, "1.0 / max(1, len(seen[i]))", "1.0 * i", WHERE_THEY_LOOK),
    of_host("in blocks: depth is not looked at", CUT, "if depth is not None:", "if depth is None and False:", SEEN),
    of_host("in blocks: points behind walls", CUT, "return np.asarray(points[away < FARTHEST * distance])", "return np.asarray(points)", SEEN),
    of_host("in blocks: the box of the whole", "scenes/formats/part.py", "box_min=box[0],", "box_min=whole.box_min,", OF_PART),
    of_host("in blocks: rooms in one row", "scenes/builtin/building.py", "columns = math.ceil(math.sqrt(n_rooms))", "columns = n_rooms", ROOMS),
    of_host("in blocks: a gap", CUT, "and abs(volume - 1.0) < ROUNDING", "", BOX),
    of_host("in blocks: twice", CUT, "for n in range(len(low))", "for n in ()", BOX),
    of_host("in blocks: beyond the box", CUT, "and within", "", BOX),
    of_host("in blocks: links", "cli/blocks.py", "    blocks.require_own_files(numbers)\n", "", LINKED),
    of_host("in blocks: any options that are stored", "blocks/train.py", ", (f\"{path}: $.options: \", before or ())", ",", STORED),
    of_host("in blocks: of a part", "blocks/folder.py", "if scene.endswith(ENDING):", "if False:", REFUSED),
    of_host("in blocks: fewer than none", "blocks/folder.py", "Annotated[int, msgspec.Meta(ge=1)]", "int", REFUSED),
]  # fmt: skip
