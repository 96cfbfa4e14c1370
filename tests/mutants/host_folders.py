"""Mutants of what finds photographs, lists, models and what is left over in a scene's folder."""

from mutant import of_host

IMAGES = "scenes/test_frame_images.py::test_"
NAMED = f"{IMAGES}photographs_are_found_by_their_names"
FRAME_IMAGES, FOUND, LEFT, UNNAMED, LISTS, MODELS, CONTENTS, TRANSFORMS_FILE = (
    f"scenes/formats/{name}.py"
    for name in (
        *("frame_images", "found_photographs", "left_over", "unnamed_photographs"),
        *("split_lists", "colmap_models", "contents", "transforms"),
    )
)
LEFT_TESTS = "scenes/test_left_over.py::test_"
LISTS_TESTS = "scenes/test_split_lists.py::test_"
MODELS_TESTS = "scenes/test_colmap_models.py::test_"
FOLDERS = "scenes/test_contents.py::test_what_a_folder_without_a_scene_holds"

MUTANTS = [
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
        " and not PHOTOGRAPHS.fullmatch(top)",
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
        "if ANY_PHOTOGRAPHS.fullmatch(folder.name) and",
        "if",
        "scenes/test_contents.py::test_photographs_of_a_scene_lead_to_it",
    ),
]
