"""Mutants of what is kept and logged of runs, of splits, and of looks at test views."""

from mutant import of_host

LEFT_OUT = "runs/test_compact.py::test_features_of_free_space_and_of_untrained_nodes_are_left_out"
CELLS = "runs/test_compact.py::test_nodes_of_a_cell_are_all_that_samples_in_it_read"
WHOLE = "runs/test_compact.py::test_what_half_precision_cannot_hold_stays_whole"
FINISHES = (
    "runs/test_saves.py::test_killed_while_it_finishes_the_last_checkpoint_or_the_field_is_whole"
)
WITHHELD = "scenes/test_split.py::test_what_is_withheld"
SIDE = "scenes/test_split.py::test_a_sector_is_side_by_side_whatever_the_names"
IN_SCENE = "scenes/test_split.py::test_a_scene_with_it"
TIME = "training/test_held_out.py::test_reports_have_the_psnr_of_test_views_where_it_is_time"
SPREAD = "training/test_held_out.py::test_a_few_views_are_spread"
TABLE = "runs/test_logs.py::test_a_table_begins_with_what_a_resumed_run_has"
REPLACED = "runs/test_logs.py::test_a_log_is_replaced_with_its_run"
WANDB = "runs/test_logs.py::test_weights_and_biases"
MIDDLE = "media/test_curves.py::test_the_mean_runs_through_the_middle"
LONGER = "training/test_trainer.py::test_a_longer_training_follows_its_own_schedule_from_there_on"
DONE = "training/test_trainer.py::test_a_training_that_is_done_needs_no_checkpoint"
QUIET = "evaluation/test_metrics.py::test_threads_of_flip_do_not_spin_and_the_environment_stays"
LINKED = "reports/test_compare.py::test_a_link_is_not_written_through"
EMPTIED = "reports/test_compare.py::test_a_record_that_was_emptied_is_not_none"
ALIVE = "runs/test_saves.py::test_what_another_process_writes_stays"
COPIED = "runs/test_links.py::test_a_copy_by_hard_links_stays_as_it_is"
COMES = "runs/test_links.py::test_a_link_that_comes_during_a_training_is_not_followed"
LATER = "runs/test_listing.py::test_a_checkpoint_tells_the_step_before_the_first_report"
EXPERIMENT, FILES, WRITING = "reports/experiment.py", "runs/files.py", "writing.py"
COMPACT, SPLIT, HELD_OUT, LOGS = (
    *("runs/compact.py", "scenes/split.py"),
    *("training/held_out.py", "runs/logs.py"),
)

MUTANTS = [
    # compact.py
    of_host("features of all nodes", COMPACT, "kept = nodes_of_cells(field.lattice, occupied) & ", "kept = ", LEFT_OUT),
    of_host("of untrained nodes", COMPACT, " & (values[..., 1:] != 0.0).any(axis=-1)", "", LEFT_OUT),
    of_host("beyond half precision", COMPACT, "return half if np.isfinite(half).all() else values", "return half", WHOLE),
    of_host("a node too few", "fields/nodes.py", "-(-(i + 1) * last // m) + 1]", "-(-(i + 1) * last // m)]", CELLS),
    of_host("a node too many", "fields/nodes.py", "-(-(i + 1) * last // m) + 1]", "(i + 1) * last // m + 2]", CELLS),
    of_host("checkpoints first", "runs/run.py", "for path in [] if keep_checkpoints else self.checkpoints:",
            "for path in self.checkpoints if keep_checkpoints else []:", FINISHES),
    # split.py
    of_host("every next", SPLIT, "[:: int(split)]", "[:: int(split) + 1]", WITHHELD),
    of_host("a large sector", SPLIT, "SECTOR = 8", "SECTOR = 4", SIDE),
    of_host("no sector", SPLIT, "np.argsort(around, kind=\"stable\")[:count]", "range(count)", SIDE),
    of_host("trained on and tested", "scenes/formats/assemble.py", "{\"train\": set(names) - test, \"test\": test}",
            "{\"train\": set(names), \"test\": test}", IN_SCENE),
    # held_out.py
    of_host("at each update", HELD_OUT, "step // self._every == self._at // self._every and ", "False and ", TIME),
    of_host("not at the end", HELD_OUT, " and self._trainer.fraction < 1.0", "", TIME),
    of_host("in all reports", HELD_OUT, "        self._new = False\n        return", "        return", TIME),
    of_host("the first views", HELD_OUT, "np.linspace(0, len(indices) - 1, min(VIEWS, len(indices)))",
            "np.linspace(0, min(VIEWS, len(indices)) - 1, min(VIEWS, len(indices)))", SPREAD),
    # logs.py, files.py, curves.py
    of_host("without the reports so far", LOGS, "\"\".join(map(_line, reports))", "\"\"", TABLE),
    of_host("steps of no report", LOGS, "self._run.log(scalars(report), step=report[\"step\"])",
            "self._run.log(scalars(report), step=0)", WANDB),
    of_host("events stay", "runs/files.py", ", *(folder / TENSORBOARD).glob(EVENTS)]", "]", REPLACED),
    of_host("a mean that lags", "media/curves.py", "total[k + half + 1] - total[k - half]", "total[k + 1] - total[k - 2 * half]",
            MIDDLE),
    # links, and what other processes write
    of_host("links in a comparison", EXPERIMENT, "require_own(matching(folder, WRITTEN), \"a comparison\")", "pass", LINKED),
    of_host("an emptied record is none", EXPERIMENT, "if found is not None and any(", "if found and any(", EMPTIED),
    of_host("what is still written is swept", FILES, "if writer == os.getpid() or not is_alive(writer):", "if True:", ALIVE),
    of_host("what has this number stays", FILES, "writer == os.getpid() or ", "", ALIVE),
    of_host("a log that is whole is not rewritten", "runs/run.py", "            if path.exists():\n",
            "            if path.exists() and rewound(path.read_bytes(), step) != path.read_bytes():\n", COPIED),
    of_host("a link is appended to", WRITING, "getattr(os, \"O_NOFOLLOW\", 0) | ", "", COMES),
    of_host("listed: the step of the last report", "runs/listing.py", "step=max(report.step, saved)", "step=report.step", LATER),
    # a longer training
    of_host("a grid that shrinks", "training/trainer.py", "if grown <= self._grown or", "if grown == self._grown or", LONGER),
    of_host("a checkpoint all the same", "training/trainer.py", "(checkpoint_when_done or self.fraction < 1.0)", "True", DONE),
    # metrics.py
    of_host("FLIP spins", "evaluation/metrics.py", "\"passive\"", "\"active\"", QUIET),
]  # fmt: skip
