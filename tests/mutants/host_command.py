"""Mutants of the command: what of a configuration its options change, and what is repeated."""

from mutant import of_host

HERE, OF_FILES = "model/test_config_options.py::", "cli/test_config_file.py::"
CHANGED = f"{HERE}test_an_option_changes_its_field_and_nothing_else"
LEFT_OUT = f"{HERE}test_what_a_preset_has_and_would_do_nothing_is_left_out"
ENDS = f"{HERE}test_of_steps_and_time_the_one_that_is_given_ends_a_training"
WORDS = f"{HERE}test_words_of_fields_that_may_be_several_things"
TAKEN = f"{HERE}test_the_command_takes_dotted_names_and_short_ones"
TWICE = f"{HERE}test_both_spellings_of_models_and_losses_are_one"
FOUND = f"{OF_FILES}test_a_files_scene_and_masks_are_found"
REFUSED = f"{OF_FILES}test_a_file_that_does_not_fit_is_refused_and_nothing_is_written"
PRESET = f"{HERE}test_help_shows_the_values_of_the_preset"
CONFIGURED, GIVEN, VALUES = "cli/configured.py", "cli/given.py", "cli/values.py"
REPEAT, TRAIN = "cli/repeat.py", "cli/train.py"

MUTANTS = (
    of_host("options: rates of the optimiser forgotten", CONFIGURED,
            'PARTS = ("grid", "march", "optim")', 'PARTS = ("grid", "march")', CHANGED),
    of_host("options: what does nothing stays", CONFIGURED,
            "sorted(_idle(after) - _idle(before))", "()", LEFT_OUT),
    of_host("options: what is requested is left out as well", CONFIGURED,
            "values[part].setdefault(field, defaults[field])",
            "values[part][field] = defaults[field]", LEFT_OUT),
    of_host("options: the time limit of a preset ends given steps", CONFIGURED,
            "return replace(config, time_limit=None)", "return config", ENDS),
    of_host("options: the steps of a preset end a given time", CONFIGURED,
            "return replace(config, steps=STEPS_OF_TIMED)", "return config", ENDS),
    of_host("options: a field given twice", GIVEN,
            "if field in values:", "if False:", TWICE),
    of_host("options: none is a word", VALUES,
            "if tuple(words) == (NONE,) and NoneType in others:", "if False:", WORDS),
    of_host("options: a count without its exponent", VALUES,
            r"e\d{1,2}", r"e\d{1,2}z", TAKEN),
    of_host("options: help of fast whatever the preset", "cli/main.py",
            '.get("--preset", "fast")', '.get("--preset", "fast") and "fast"', PRESET),
    of_host("streams: closed ones are none", "cli/main.py", "if getattr(sys, name) is None:", "if False:",
            "cli/test_command.py::test_streams_that_are_closed_take_nothing_away"),
    of_host("repeat: the scene beside the folder of this process", REPEAT,
            "scene=str(path.parent / config.scene)", "scene=config.scene", FOUND),
    of_host("repeat: fields of parts are not looked at", REPEAT,
            'yield from (f"{name}.{inner}" for inner in value)', "yield from ()", REFUSED),
    of_host("resume: a name stands for its defaults", TRAIN, "changed(decided).for_kind", "config.for_kind",
            "runs/test_run_finished.py::test_what_auto_stood_for_may_be_named_when_views_are_left_to_look_at"),
    of_host("resume: no word of a limit lowered", TRAIN, "if new < told:", "if False:",
            "cli/test_resume_command.py::test_a_finished_run_is_trained_for_longer"),
    of_host("repeat: masks of another scene", TRAIN,
            "if options.scene is None:  # and not another", "if True:  # and not another", FOUND),
    of_host("repeat: photographs of another size", TRAIN,
            "downscale=run.downscale)", "downscale=1)", FOUND),
)  # fmt: skip
