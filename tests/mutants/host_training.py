"""Mutants of the host's code that trains: what kernels get, schedule, files, presets."""

from mutant import of_host

STEP = "training/test_training_step.py::test_one_step_against_the_oracle"
BOUNDED, LOSSES, CONTRACTED = f"{STEP}[bounded]", f"{STEP}[all losses]", f"{STEP}[contracted]"
NDC, MLP, PLAIN = f"{STEP}[ndc]", f"{STEP}[an mlp]", f"{STEP}[without scaling]"
SEED = "training/test_training_step.py::test_the_seed_decides_weights_and_rays"
SHARED = "training/test_training_step.py::test_steps_that_share_an_update_are_added_up"
EMPTY = "training/test_training_step.py::test_rays_that_meet_nothing_count_in_the_mean"
VARIATION = (
    "training/test_training_step.py::test_total_variation_joins_as_strongly_as_it_is_asked_to"
)
EACH_DISTANCE = "scenes/test_points.py::test_training_takes_each_camera_s_distance"
FIRST_GRID = (
    "scenes/test_extent.py::test_the_first_grid_is_empty_but_for_the_density_that_is_asked_for"
)
FEW_STEPS = "scenes/test_extent.py::test_steps_of_which_no_kernel_would_come_to_an_end_are_refused"
STEPS = "scenes/test_extent.py::test_steps_are_as_long_as_they_are_asked_to_be"
CLIPPED = "scenes/test_extent.py::test_near_and_far_that_leave_no_sample_are_refused"
BEHIND = "scenes/test_extent.py::test_what_is_behind_the_scene_is_what_is_asked_for"
ALL_DRAWN = "scenes/test_extent.py::test_in_folded_space_all_pixels_are_drawn"
BETWEEN = "scenes/test_points.py::test_by_default_they_lie_between_each_camera_s_and_the_scene_s"
FEWER = "scenes/test_overlap.py::test_where_many_see_the_same_gradients_are_scaled_less_far"
AUTO_KEPT = "fields/test_factors_training.py::test_auto_stays_what_it_was_when_a_training_began"
CAME_AFTER = (
    "reports/test_compare.py::test_options_that_came_after_an_experiment_began_have_their_defaults"
)
AUTO = "fields/test_factors_training.py::test_auto_is_vm_for_objects_alone"
GROWTH = "training/test_trainer.py::test_growth_lets_the_optimiser_begin_anew"
SHIFT = "training/test_trainer.py::test_growth_takes_its_shift_from_densities"
GROWS = "training/test_trainer.py::test_the_grid_of_an_object_grows_earlier_into_a_tighter_box"
TV_ENDS = "training/test_trainer.py::test_total_variation_ends_when_it_is_told_to"
SECONDS = "training/test_trainer.py::test_seconds_before_the_resumption_count"
SAVED = "training/test_trainer.py::test_checkpoints_come_when_due_and_at_the_end"
RESUMED = "training/test_trainer.py::test_train_resumes_too_and_leaves_the_state_alone"
MORE_STEPS = "training/test_updates.py::test_updates_take_more_steps_as_training_goes_on"
REPORTS = "training/test_updates.py::test_reports_come_as_often_where_an_update_takes_many_steps"
ROOT_OF_STEPS = (
    "training/test_schedule.py::test_rates_decay_and_grow_with_the_root_of_the_root_of_the_steps"
)
SCALES = "training/test_smoothing.py::test_the_scales_of_the_rays_at_points"
SMOOTHED = "training/test_smoothing.py::test_a_training_smooths_less_what_is_near"
NEAR_DECAY = "fields/test_near_decay.py"
TILE_DECAY = f"{NEAR_DECAY}::test_each_tile_has_that_of_its_middle_node"
FAR_DECAY = f"{NEAR_DECAY}::test_places_at_infinity_have_none"
BENT_DECAY = f"{NEAR_DECAY}::test_a_lens_that_bends_sees_all_along_its_rays"
DECAYED = f"{NEAR_DECAY}::test_an_update_lowers_the_densities_that_it_moves"
OF_EXPOSURE = "training/test_exposure.py::test_"
(
    FIRST_SHARE,
    DIFFER_ALONE,
    JUDGES_ONCE,
    IN_TIME,
    COUNT_LESS,
    AS_THEY_STAND,
    EXPOSED_RESUMED,
    EXPOSED_REFUSED,
) = (
    f"{OF_EXPOSURE}{name}"
    for name in (
        "the_first_share_of_a_training_has_none",
        "auto_fits_those_that_differ_alone",
        "auto_judges_once_it_is_time",
        "auto_leaves_photographs_as_they_are_where_it_cannot_begin_in_time",
        "older_rays_count_less_by_how_many_came_since",
        "batches_are_drawn_by_the_exposures_as_they_stand",
        "resumed_it_ends_the_same",
        "what_does_not_fit_the_photographs_is_refused",
    )
)
ROOM_ALIKE, BALANCE, LIMIT_RAISED, ONE_PHOTOGRAPH = (
    f"{OF_EXPOSURE}{name}"
    for name in (
        "photographs_of_the_room_are_alike",
        "brightness_is_judged_and_not_white_balance",
        "a_limit_that_is_raised_leaves_exposures_as_they_are",
        "the_mean_of_one_photograph_is_itself",
    )
)
CORRECTED = "evaluation/test_metrics.py::test_corrected_colours_are_those_of_another_exposure"
LIMIT_EXPOSURES = (
    "reports/test_limits.py::test_exposures_are_named_where_corrected_colours_come_closer"
)
SETTLED, BEFORE_SETTLED, HASH_SETTLED, SHORT_SETTLED = (
    f"training/test_settling.py::test_{what}"
    for what in (
        "once_it_has_settled_less_is_sampled",
        "settled_it_is_resumed_as_it_was",
        "a_hash_is_judged_with_its_neighbours",
        "short_trainings_do_not_settle",
    )
)
SHORT_USES = "model/test_idle_options.py::test_a_short_training_takes_over_what_it_has_a_use_for"
FACE = "training/test_optim.py::test_total_variation_counts_the_face_between_two_nodes"
ADAM_WEIGHTS = (
    "training/test_optim.py::test_weights_are_updated_by_the_sum_of_the_workers_gradients"
)
RATES = "model/test_models.py::test_each_number_of_a_node_learns_at_its_rate"
FIRST_WEIGHTS = "model/test_models.py::test_first_weights_are_uniform_and_those_of_the_output_small"
DIGEST, LENS = (
    f"training/test_state.py::test_the_digest_sees_{what}"
    for what in ("what_training_sees", "the_lens")
)
SEARCH = (
    "training/test_coarse.py::test_it_takes_a_tenth_of_the_steps_and_an_eighth_of_the_time_at_most"
)
NEEDED = "training/test_coarse.py::test_it_is_for_scenes_without_points"
MEDIAN = "training/test_coarse.py::test_median_distance_in_fog"
COMES_BACK = "runs/test_checkpoint.py::test_a_training_comes_back_bit_for_bit"
FORGED = "runs/test_checkpoint.py::test_a_forged_training_is_refused"
SAYS = "training/test_plan.py::test_it_says_what_is_trained"
WAITS = "training/test_plan.py::test_a_plan_that_waits_for_a_short_training_is_refused"
GOES_BY = "training/test_plan.py::test_a_resumed_training_goes_by_the_plan_that_it_began_with"
MEET, LEARN, LOST = (
    f"runtime/test_meeting.py::test_{name}"
    for name in (
        "nobody_goes_on_before_all_have_come",
        "all_learn_what_each_has_said_each_time",
        "one_that_is_lost_is_noticed",
    )
)
PROCESSES = "training/test_processes.py::test_processes_with_a_share_of_the_rays_are_one_with_all"
REDUCED = "training/test_plan.py::test_gradients_are_reduced_before_they_are_regularised"
WITHOUT_PLAN = (
    "runs/test_old_checkpoints.py::test_a_training_without_a_plan_goes_on_as_it_would_have"
)
OLDER_DISTANCES = "scenes/test_points.py::test_a_checkpoint_of_one_distance_for_all_goes_on_so"
PUBLISHED = "model/test_presets.py::test_those_of_dvgo_are_what_is_published"
CHOSEN = (
    "model/test_presets.py::test_losses_and_rates_of_the_everyday_ones_are_those_that_were_chosen"
)

TRAINER, EXTENT, SMOOTHING = (
    "training/trainer.py",
    "training/extent.py",
    "fields/total_variation.py",
)
NEAR, SKIPPED = "fields/near_decay.py", "training/free_space.py"
PLANNED, GROWN = "training/plan.py", "training/growth.py"
OPTIM, STATE, COARSE = (f"training/{name}.py" for name in ("optim", "state", "coarse"))
SPACE_PLAN = "scenes/extent/space_plan.py"
SCHEDULE, CHECKPOINT = "training/schedule.py", "runs/checkpoint.py"
KEPT = "runs/optimiser_tensors.py"
CACHE, PARALLEL = "runtime/kernel_cache.py", "runtime/parallel.py"
LOADED = "runtime/test_parallel.py::test_one_kernel_of_each_module_is_loaded_once"
RAYS, RENDER, JOINED = (f"rendering/{name}.py" for name in ("rays", "render", "losses"))
MARCH = "rendering/steps.py"

MUTANTS = [
    # trainer.py, free_space.py: what kernels get
    of_host("one distance for every ray", SKIPPED, "np.array(plan.content_distances),",
            "np.full(len(plan.content_distances), plan.content_distance),", EACH_DISTANCE),
    of_host("one distance for every ray, in a step", SKIPPED, "np.array(plan.content_distances),",
            "np.full(len(plan.content_distances), plan.content_distance),", BOUNDED),
    of_host("no jacobian", TRAINER, "            self.config.jacobian,\n            self.workers,\n",
            "            \"none\",\n            self.workers,\n", CONTRACTED),
    of_host("no scaling", TRAINER,
            "            self.config.scaling,\n            self.config.jacobian,\n            self.workers,\n",
            "            \"none\",\n            self.config.jacobian,\n            self.workers,\n", BOUNDED),
    of_host("scaled where it shall not be", TRAINER,
            "            self.config.scaling,\n            self.config.jacobian,\n            self.workers,\n",
            "            \"clamped\",\n            self.config.jacobian,\n            self.workers,\n", PLAIN),
    of_host("no jitter", SKIPPED, "config.march.jitter,", "False,", BOUNDED),
    of_host("always jitter", SKIPPED, "config.march.jitter,", "True,", CONTRACTED),
    of_host("distortion in scene units", TRAINER,
            "Objective(config=losses, content_distance=self.plan.content_distance)",
            "Objective(config=losses)", LOSSES),
    of_host("no losses", TRAINER,
            "Objective(config=losses, content_distance=self.plan.content_distance)",
            "Objective(content_distance=self.plan.content_distance)", LOSSES),
    of_host("all rays count as drawn", TRAINER,
            "self._pass.run(self.free, batch, n_steps, share)",
            "self._pass.run(self.free, batch, n_steps)", EMPTY),
    of_host("nothing is free", TRAINER, "self._pass.run(self.free, batch",
            "self._pass.run(FreeCells.none(self.workers), batch", EMPTY),
    of_host("steps count as one", TRAINER, "self._pass.run(self.free, batch, n_steps, ",
            "self._pass.run(self.free, batch, 1, ", SHARED),
    of_host("one step's rays", TRAINER, "self._sampler.draw(self.steps_done, n_steps, (",
            "self._sampler.draw(self.steps_done, 1, (", SHARED),
    of_host("the same batch again", TRAINER, "self._sampler.draw(self.steps_done, n_steps, (",
            "self._sampler.draw(0, n_steps, (", SHARED),
    of_host("another seed", SKIPPED, "config.seed,\n        workers,", "0,\n        workers,", SEED),
    of_host("weights of any seed", TRAINER, "first_weights(self.model, config.seed,", "first_weights(self.model, 0,", SEED),
    of_host("a random background is black", PLANNED, "\"random\": (1.0, 1.0, 1.0)",
            "\"random\": (0.0, 0.0, 0.0)", BEHIND),
    of_host("random is white", SKIPPED, "None if plan.random_background else plan.background",
            "plan.background", BEHIND),
    of_host("before black, whatever they are", PLANNED, "\"white\" if scene.has_alpha else \"black\"",
            "\"black\"", BEHIND),
    of_host("contracted space is left out", SKIPPED, " and lattice.kind.bounded\n", "\n", ALL_DRAWN),
    of_host("total variation as of one step", TRAINER, "self._updates, fraction, n_steps)",
            "self._updates, fraction, 1)", VARIATION),
    of_host("total variation of the grid that is", GROWN, "voxels=config.grid.n_nodes,",
            "voxels=math.prod(plan.stages[0].size),", VARIATION),
    of_host("smooths the near as the far", GROWN, "scaling=config.scaling,", "scaling=\"none\",", SMOOTHED),
    of_host("smoothing minds no near plane", GROWN, "near=config.march.near,", "near=0.0,",
            SMOOTHED),
    of_host("total variation to the end", SMOOTHING, " or fraction >= self.until", "", TV_ENDS),
    of_host("total variation at every update", SMOOTHING, "update % self.every != 0 or ", "",
            VARIATION),
    of_host("bias of one step more", TRAINER, "self._updates - self._restarted,", "self.steps_done + 1,", GROWTH),
    of_host("no shift at growth", GROWN, "density_shift=grown.density_shift - shift",
            "density_shift=grown.density_shift", SHIFT),
    of_host("one shift for all growths", TRAINER, "(grown - self._grown) * config", "grown * config", SHIFT),
    of_host("moments are kept", TRAINER, "            self._restarted = self._updates\n", "", GROWTH),
    of_host("the box stays", SKIPPED, "return box_min + occupied[0] * edges, box_min + occupied[1] * edges",
            "return box_min, box_max", GROWS),
    of_host("time does not count", TRAINER, "done = max(done, self._seconds / self.config.time_limit)", "pass", SECONDS),
    of_host("checkpoints at the end only", TRAINER, "if agreed.save and on_checkpoint is not None:",
            "if agreed.save and on_checkpoint is None:", SAVED),
    of_host("resumes in the state's arrays", TRAINER, "        state = state.copied_to(self.workers.device)\n", "",
            RESUMED),
    of_host("opacity of objects", PLANNED, "plan.kind == \"object\" and plan.losses.opacity != 0.0",
            "False", "kernels/test_losses.py::test_photographs_with_alpha_need_not_be_opaque"),
    # rays.py, render.py, losses.py
    of_host("sampler: no jitter", RAYS, "self._draw.jitter = int(jitter)", "self._draw.jitter = 0", BOUNDED),
    of_host("sampler: black behind", RAYS, "background_mode = kernels.RANDOM_BACKGROUND", "background_mode = 0", BOUNDED),
    of_host("sampler: rays that meet nothing", RAYS, "np.flatnonzero(room.picked_views.numpy()[:n_picked] >= 0)",
            "np.arange(n_picked)", EMPTY),
    of_host("loading: continues after an error", PARALLEL, "list(waiting)  # nobody", "pass  # nobody",
            "runtime/test_parallel.py::test_an_error_in_loading_is_raised"),
    of_host("loading: a second time", PARALLEL, "self._loaded.update(kernels)", "pass", LOADED),
    of_host("loading: all of a module", PARALLEL, "{kernel.module: kernel for", "{kernel: kernel for", LOADED),
    of_host("loading: one after the other", PARALLEL, "range(1, min(cores, len(modules), COMPILED_AT_ONCE))",
            "range(0)",
            "runtime/test_parallel.py::test_several_threads_load_at_once"),
    of_host("loading: a module by two threads", CACHE, "loading = _loading.setdefault(module, threading.Lock())",
            "loading = threading.Lock()", "runtime/test_kernel_cache.py::test_one_thread_loads_a_module_and_others_load_others"),
    of_host("loading: it failed for good", CACHE, "module.unload()  # forgets that it failed", "pass",
            "runtime/test_kernel_cache.py::test_a_library_loads_once_the_cause_is_gone"),
    of_host("pass: a sum", RENDER, "n_batches * share / batch.count", "n_batches * share", BOUNDED),
    of_host("pass: no near plane", MARCH, "march.near = 0.0 if self.in_ndc else self.near", "march.near = 0.0",
            BOUNDED),
    of_host("pass: light to the end", MARCH, "march.transmittance_min = self.transmittance_min",
            "march.transmittance_min = 0.0", BOUNDED),
    of_host("pass: no growth", MARCH, "march.growth = self.growth", "march.growth = 0.0", CONTRACTED),
    of_host("pass: grows at once", MARCH, "march.n_linear = self.n_linear", "march.n_linear = 0", CONTRACTED),
    of_host("losses: no delta", JOINED, "values.photometric.delta = config.huber_delta",
            "values.photometric.delta = 0.1", LOSSES),
    of_host("losses: of weight one", JOINED, "params.factor = getattr(config, name)", "params.factor = 1.0", LOSSES),
    of_host("losses: near clip at one", JOINED, "params.distance = config.near_clip_distance",
            "params.distance = 1.0", LOSSES),
    of_host("losses: colours of samples once", JOINED, "values.on_samples.factor = config.sample_colour",
            "values.on_samples.factor = 1.0", LOSSES),
    # extent.py
    of_host("density of half a voxel", GROWN, "density_scale=1.0 / voxel", "density_scale=2.0 / voxel", FIRST_GRID),
    of_host("opacity as density", GROWN, "math.expm1(-math.log1p(-config.grid.alpha_init))",
            "config.grid.alpha_init", FIRST_GRID),
    of_host("voxels of the first grid", GROWN, "space.voxel_edges(plan.stages[-1].size)",
            "space.voxel_edges(plan.stages[0].size)", FIRST_GRID),
    of_host("a border around any box", SPACE_PLAN, "if not kind.contracts:\n        return space", "if False:\n        return space",
            FIRST_GRID),
    of_host("steps without end through the box", EXTENT, "_require_few(march, across, step, MOST_STEPS)", "pass", FEW_STEPS),
    of_host("steps without end to the box", EXTENT, "_require_few(march, reach, step, MOST_LINEAR)", "pass", FEW_STEPS),
    of_host("FAR_BOXES", EXTENT, "FAR_BOXES = 64.0", "FAR_BOXES = 8.0", STEPS),
    of_host("far from the camera", EXTENT, "FAR_BOXES * half + reach if", "FAR_BOXES * half if", STEPS),
    of_host("steps of one voxel", EXTENT, "march.step_voxels * float(", "float(", STEPS),
    of_host("steps of the longest edge", EXTENT, "space.voxel_edges(size).min()", "space.voxel_edges(size).max()", STEPS),
    of_host("equal steps to the reach, without near", EXTENT, "(reach - march.near) / step", "reach / step", STEPS),
    of_host("growth in a box", EXTENT, "_growth(march, space) if space.contracted else 0.0", "min(GROWTH, MOST_GROWTH)",
            STEPS),
    of_host("one growth for all borders", EXTENT, "min(GROWTH / space.border, MOST_GROWTH)", "MOST_GROWTH",
            "scenes/test_extent.py::test_steps_grow_as_the_border_says_unless_they_are_told"),
    of_host("no light is too little", EXTENT, "transmittance_min=march.transmittance_min",
            "transmittance_min=0.0", STEPS),
    of_host("near may pass the box", EXTENT, "if march.near >= end:", "if march.near >= 2.0 * end:", CLIPPED),
    of_host("far may end before the box", EXTENT, "march.far <= begin:", "march.far <= 0.5 * begin:", CLIPPED),
    of_host("far is bounded in contracted space", EXTENT, "        begin = 0.0  # space", "        pass  # space", CLIPPED),
    of_host("each camera's own", EXTENT, "[share * math.sqrt(one * float(own)) for own in each]",
            "[share * float(own) for own in each]", BETWEEN),
    of_host("0.7 for many without a common point", EXTENT, "LEAST_SHARE_AROUND = 0.5, 0.7",
            "LEAST_SHARE_AROUND = 0.7, 0.7", FEWER),
    of_host("half for many around one thing", EXTENT, "LEAST_SHARE_AROUND = 0.5, 0.7",
            "LEAST_SHARE_AROUND = 0.5, 0.5", FEWER),
    of_host("less far for few", EXTENT, "FEW_VIEWS = 7.0", "FEW_VIEWS = 5.0", FEWER),
    # schedule.py
    of_host("grows late", SCHEDULE, "fraction >= at for at in self.grow_at", "fraction > at + 0.1 for at in self.grow_at",
            GROWS),
    of_host("twice as many steps, added", SCHEDULE, "return 1 << sum(fraction", "return 1 + sum(fraction", MORE_STEPS),
    of_host("room for one step", SCHEDULE, "return 1 << len(self", "return 1 + len(self", SHARED),
    of_host("no decay", SCHEDULE, "max(0.0, fraction - begin)", "(0.0 * fraction)", GROWTH),
    of_host("decay continues at growth", SCHEDULE, "max(0.0, fraction - begin)", "fraction",
            GROWTH),
    of_host("rates of n steps", SCHEDULE, "n_steps**0.25", "n_steps**0.5",
            ROOT_OF_STEPS),
    # plan.py
    of_host("one size for all growths", PLANNED, "config.grid.nodes_after(grown, kind)",
            "config.grid.nodes_after(0, kind)", SAYS),
    of_host("a search that is due is left out", PLANNED, "looks_first = not looked and ", "looks_first = False and ",
            WAITS),
    of_host("what is auto is decided again", TRAINER, "plan = resume.plan_of(scene, asked)",
            "plan = resolve(scene, asked, looked=True)", GOES_BY),
    of_host("gradients are not reduced", TRAINER, "        self._add_gradients()\n", "", REDUCED),
    of_host("all processes draw the same rays", RAYS, "self._n_rays + begin\n", "self._n_rays\n", PROCESSES),
    of_host("a flag stands for its tile alone", "torch/processes.py",
            "    holds[1:] |= touched[:-1]\n", "", PROCESSES),
    of_host("a share of the rows stays as it is", "torch/processes.py", "dim=1)[self.rank]", "dim=1)[0]", PROCESSES),
    of_host("nothing is known of who is lost in growth", TRAINER, "        if self.peers.count > 1 and self.steps_done:  # of which one may be lost meanwhile\n            self.report()\n", "", "training/test_processes.py::test_one_that_is_lost_while_the_grid_grows_ends_the_others_likewise"),
    of_host("a meeting of one", "runtime/meeting.py", "while (self._come < self._times).any():", "while False:", MEET),
    of_host("a meeting where all say the first's", "runtime/meeting.py", "half[self._rank] = numbers", "half[0] = numbers", LEARN),
    of_host("a meeting that the dead come to", "runtime/meeting.py", "if not lives:", "if False:", LOST),
    of_host("a meeting without end", "runtime/meeting.py", "if not in_time:", "if False:", LOST),
    of_host("zombies live", "runtime/process.py", '[:1] != [b"Z"]', '[:1] != [b"?"]', "runtime/test_meeting.py::test_a_zombie_is_not_alive"),
    of_host("a share of the shared tiles stays as it is", "torch/processes.py", "            self.rank,\n            n_tiles,", "            0,\n            n_tiles,", PROCESSES),
    of_host("no gradient lies in shared memory", TRAINER, "config.threads, peers.zeros)", "config.threads)", PROCESSES),
    of_host("the shared are not summed", "torch/processes.py", "            add()\n", "            pass\n", PROCESSES),
    of_host("each process's mean is over its own rays", TRAINER,
            "share = batch.count / self._sampler.count(n_steps)", "share = 1.0", PROCESSES),
    of_host("an older reach is the distance", PLANNED, "one, distances, self.reach)", "one, distances, one)", WITHOUT_PLAN),
    of_host("older distances are forgotten", PLANNED, "list(self.content_distances or [one] * n_views)",
            "[one] * n_views", OLDER_DISTANCES),
    # smoothing.py
    of_host("scale for its square", SMOOTHING, "np.square(np.minimum(square, 1.0))", "np.minimum(square, 1.0)", SCALES),
    of_host("rays all alike", SMOOTHING, "seen / (square * np.square(unit).astype(np.float32))",
            "seen / np.ones_like(square)", SCALES),
    of_host("no root", SMOOTHING, "np.sqrt(mean)", "mean", SCALES),
    of_host("near is not minded", SMOOTHING, "sampled = square >= near * near", "sampled = square >= 0.0", SCALES),
    of_host("all around", SMOOTHING, "    if camera.fisheye:\n        return -1.0\n", "    return -1.0\n", SCALES),
    of_host("a fisheye's corner", SMOOTHING, "    if camera.fisheye:\n        return -1.0\n", "", SCALES),
    of_host("of the run's first node", "fields/nodes.py", "runs * length + length // 2", "runs * length", SMOOTHED),
    of_host("of the tile's first node", "fields/nodes.py", "runs * length + length // 2", "runs * length", TILE_DECAY),
    of_host("a picture upside down", NEAR, "*-up, *-back", "*up, *-back", TILE_DECAY),
    of_host("pixels of one axis", NEAR, "camera.fx * camera.fy", "camera.fx * camera.fx", TILE_DECAY),
    of_host("cameras where the origin is", NEAR, "places = np.clip(np.nan_to_num(points - middle,",
            "places = np.clip(np.nan_to_num(points,", TILE_DECAY),
    of_host("margins of the box everywhere", NEAR, "voxel_edges(lattice, points), nan",
            "np.full(len(points), lattice.voxel_size.mean()), nan", FAR_DECAY),
    of_host("a picture as if nothing bent it", NEAR, "on_plane = shown[:, :2] / shown[:, 2:]",
            "on_plane = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]", BENT_DECAY),
    of_host("a decay of one learning rate", "fields/dense.py", "where, strength, workers", "where, 1.0, workers", DECAYED),
    of_host("auto: undecided where a training is resumed", "training/state.py",
            "decided, begun = config.for_kind(plan.kind), plan.config", "decided, begun = config, plan.config", AUTO),
    of_host("auto: what it is today where a training is resumed", "training/state.py", "if config.field == AUTO_FIELD and type",
            "if False and type", AUTO_KEPT),
    of_host("auto: voxels of today where a training is resumed", "training/state.py", "if config.grid.voxels == \"auto\":", "if False:",
            AUTO_KEPT),
    of_host("options of another version dropped", "reports/experiment.py", "if _has_all(today, tree):", "if True:", CAME_AFTER),
    of_host("auto: vm for all", "config.py", "OBJECT_FIELD if kind == \"object\" and not configured else DENSE", "OBJECT_FIELD", AUTO),
    of_host("auto: whatever is configured", "config.py", "kind == \"object\" and not configured", "kind == \"object\"", AUTO),
    of_host("auto: as many voxels whatever it is stored in", "config.py", "voxels=field.auto_voxels", "voxels=self.field.auto_voxels", AUTO),
    of_host("a decay that no update has", TRAINER, "self.workers, self._decays)", "self.workers)", DECAYED),
    of_host("a decay that is always on", "fields/dense.py", "if strength == 0.0:", "if False:", DECAYED),
    of_host("a decay in the short training", COARSE, ", near_decay=0.0)", ")", SHORT_USES),
    # exposure.py
    of_host("exposures: fitted from the start", "training/exposure.py", "fraction >= BEGIN and drawn >= FIRST_RAYS", "True", FIRST_SHARE),
    of_host("exposures: auto takes all", "training/exposure.py", ">= DIFFERENT", ">= 0.0", DIFFER_ALONE),
    of_host("exposures: auto takes none", "training/exposure.py", ">= DIFFERENT", ">= 9.0", DIFFER_ALONE),
    of_host("exposures: auto judges again", "training/exposure.py", "        if self.settled:\n            return self\n        if not self.used:", "        if not self.used:", JUDGES_ONCE),
    of_host("exposures: auto does not wait for rays", "training/exposure.py", "(drawn < JUDGED_RAYS and fraction < JUDGED_BY)", "False", JUDGES_ONCE),
    of_host("exposures: a blur is judged", "training/exposure.py", "JUDGED, JUDGED_RAYS = 0.08, 1_300_000", "JUDGED, JUDGED_RAYS = 0.08, 0", ROOM_ALIKE),
    of_host("exposures: white balance is brightness", "training/exposure.py", "(gains + 2.0 * offsets).mean(axis=1)", "(gains + 2.0 * offsets).max(axis=1)", BALANCE),
    of_host("exposures: never judged where time is short", "training/exposure.py", "(drawn < JUDGED_RAYS and fraction < JUDGED_BY)", "drawn < JUDGED_RAYS", JUDGES_ONCE),
    of_host("exposures: too late is early enough", "training/exposure.py", "None if fraction > LATEST else self", "self", IN_TIME),
    of_host("exposures: drawn by what is dropped", "training/exposure.py", "        self.offsets.zero_()\n", "", BALANCE),
    of_host("exposures: begun again by a higher limit", "training/exposure.py", "self.used = self.used or (", "self.used = (", LIMIT_RAISED),
    of_host("exposures: each process judges", "training/exposure.py", "peers.from_first(self._differ)", "(peers.rank == 0)", PROCESSES),
    of_host("exposures: of one photograph", "training/exposure.py", "and n_views == 1:", "and False:", ONE_PHOTOGRAPH),
    of_host("exposures: any numbers are sums", "training/exposure.py", "(n >= 0).all() and ", "", EXPOSED_REFUSED),
    of_host("exposures: variances below 0", "training/exposure.py", " and (n * xx - x * x >= -n).all()", "", EXPOSED_REFUSED),
    of_host("exposures of test views were fitted", "reports/limits.py", '"cc_psnr" if exposed else "psnr"', '"psnr"', LIMIT_EXPOSURES),
    of_host("exposures: older rays by all that came", "training/exposure.py", "(n_views * WINDOW)", "WINDOW", COUNT_LESS),
    of_host("exposures: none drawn", TRAINER, "            self._sampler.take_out_exposures(self.exposures.gains, self.exposures.offsets)\n", "            pass\n", AS_THEY_STAND),
    of_host("exposures: begun again", "training/exposure.py", "workers, appearance == \"affine\", kept)", "workers, appearance == \"affine\")", EXPOSED_RESUMED),
    of_host("exposures: judged again where resumed", "training/exposure.py", "self.sums, self.settled = state[\"sums\"], bool(state[\"settled\"].numpy()[0])", "self.sums = state[\"sums\"]", JUDGES_ONCE),
    of_host("exposures: without those of other processes", TRAINER, "            accumulated.append(self.exposures.accumulated)\n", "            pass\n", PROCESSES),
    of_host("exposures: of any number of photographs", "training/exposure.py", "if self.sums.size != n_views * NUMBERS:", "if False:", EXPOSED_REFUSED),
    of_host("exposures: no number", KEPT, "or not are_sums(sums):", "or False:", EXPOSED_REFUSED),
    of_host("exposures: affine, but not settled", KEPT, "(1.0,) if config.appearance", "(0.0, 1.0) if config.appearance", EXPOSED_REFUSED),
    of_host("exposures: in the short training", COARSE, '        appearance="none",\n', "", SHORT_USES),
    of_host("corrected by the whole picture", "evaluation/metrics.py", "(a, b) if mask is None else (a[mask], b[mask])", "(a, b)", CORRECTED),
    of_host("corrected beyond white", "evaluation/metrics.py", "np.clip(mean_y + gain * (a - mean_x), 0.0, 1.0)", "mean_y + gain * (a - mean_x)", CORRECTED),
    of_host("exposures are photographs that are missing", "reports/limits.py", "cost=gap - of_exposures - USUAL_GAP", "cost=gap - USUAL_GAP", LIMIT_EXPOSURES),
    # free_space.py, from settle_at on
    of_host("settled: never", SKIPPED, "if self._settled or at is None or fraction < at", "if True or at is None or fraction < at", SETTLED),
    of_host("settled: from the start", SKIPPED, "or fraction < at or", "or", BEFORE_SETTLED),
    of_host("settled: neighbours count as well", SKIPPED, "margin = 0 if self._settled and", "margin = 0 if False and", SETTLED),
    of_host("settled: a hash without neighbours", SKIPPED, " and storage.kind.seen_share == 1.0 else 1", " else 1", HASH_SETTLED),
    of_host("settled: in short trainings", SKIPPED, " or steps_done < FIRST_SETTLED", "", SHORT_SETTLED),
    of_host("settled: rays end where they did", SKIPPED, "transmittance_min=SETTLED_TRANSMITTANCE)", "transmittance_min=MarchConfig.transmittance_min)", SETTLED),
    of_host("settled: whatever is configured", SKIPPED, "if not (self._settled and usual):", "if not self._settled:", SETTLED),
    of_host("settled: before the grid has grown", TRAINER, "return grown and self._space", "return self._space", SETTLED),
    of_host("settled: not where it is resumed", TRAINER, "resume is not None and has_settled(resume)", "False", BEFORE_SETTLED),
    # optim.py
    of_host("edges for faces", SMOOTHING, "** (2.0 / 3.0)", "** (1.0 / 3.0)", FACE),
    of_host("each update's own", SMOOTHING, "factor = face * self.every * ", "factor = face * ", FACE),
    of_host("noise of all steps", SMOOTHING, "math.sqrt(n_steps)", "n_steps", FACE),
    of_host("beta2 in the first moment's bias", OPTIM, "correction1 = 1.0 / (1.0 - config.beta1**update.number)",
            "correction1 = 1.0 / (1.0 - config.beta2**update.number)", ADAM_WEIGHTS),
    of_host("rates without the schedule", OPTIM, "update.factor * float(parameter.learning_rates[0])",
            "float(parameter.learning_rates[0])", ADAM_WEIGHTS),
    # models
    of_host("the deferred output as large", "model/models.py",
            "uniform_weights(self.layout(loader(\"float32\")), seed, 0.1)",
            "uniform_weights(self.layout(loader(\"float32\")), seed, 1.0)", FIRST_WEIGHTS),
    of_host("a residual as large", "model/models.py", "0.1 if self.residual else 1.0", "1.0", FIRST_WEIGHTS),
    of_host("rate of the constant harmonic", "model/models.py", "optim.learning_rate_rgb / 0.2820948",
            "optim.learning_rate_rgb", RATES),
    of_host("colour at the rate of features", "model/models.py", "begin = 4 if self.residual else 1", "begin = 1", RATES),
    of_host("features at the rate of colour", "model/models.py",
            "rates[4 : 1 + self.n_features] = self.learning_rate_features",
            "rates[5 : 1 + self.n_features] = self.learning_rate_features", RATES),
    of_host("weights of one sign", "model/interface.py",
            "weights[begin:end] = rng.uniform(-limit,", "weights[begin:end] = rng.uniform(0.0,", FIRST_WEIGHTS),
    of_host("an MLP at twice its rate", "fields/parameters.py", "np.array([model.learning_rate_mlp])",
            "np.array([2.0 * model.learning_rate_mlp])", ADAM_WEIGHTS),
    # state.py
    of_host("digest: no distortion", STATE, "np.round([*distortion, *camera.c2w[:, :3].ravel()], 5)",
            "np.round(camera.c2w[:, :3].ravel(), 5)", LENS),
    of_host("digest: fisheye or not", STATE, "[camera.k4, 1.0] if camera.fisheye else []", "[]", LENS),
    of_host("digest: no divisor", STATE, "[camera.k4, camera.k5, camera.k6] if camera.rational else []", "[]", LENS),
    of_host("digest: any focal length", STATE, "np.round(lens, 3)", "np.round(lens[2:], 3)", DIGEST),
    of_host("digest: any pixels", STATE, "        digest.update(np.ascontiguousarray(view.image).data)\n", "", DIGEST),
    of_host("digest: any place", STATE, "            np.round(camera.position / unit, 5),\n", "", DIGEST),
    of_host("digest: any masks", STATE, "digest.update(b\"mask\" + np.packbits(mask).tobytes())", "pass",
            "scenes/test_masks.py::test_a_training_knows_its_masks"),
    of_host("may change: the seed", STATE, "MAY_CHANGE = (\"device\",", "MAY_CHANGE = (\"seed\", \"device\",",
            "training/test_trainer.py::test_another_configuration_is_refused_by_name"),
    # coarse.py
    of_host("TIME_SHARE", COARSE, "TIME_SHARE = 0.12", "TIME_SHARE = 0.9", SEARCH),
    of_host("each round as much", COARSE, "TIME_SHARE * limit / rounds", "TIME_SHARE * limit", SEARCH),
    of_host("STEPS_SHARE", PLANNED, "STEPS_SHARE = 0.1", "STEPS_SHARE = 0.3", SEARCH),
    of_host("one round", COARSE, "ROUNDS = 2", "ROUNDS = 1", SEARCH),
    of_host("the second round's distance", COARSE,
            "            small = replace(small, content_distance=found.content_distance)\n", "            pass\n", SEARCH),
    of_host("as it is scaled", COARSE, "        scaling=\"clamped\",", "        scaling=config.scaling,",
            "training/test_coarse.py::test_trainings_with_and_without_scaling_have_one_extent"),
    of_host("points do not tell", PLANNED, "scene.content_distances is not None or coarse_steps", "coarse_steps", NEEDED),
    of_host("objects as well", PLANNED, " and not scene.has_alpha", "", NEEDED),
    of_host("where any light has ended", COARSE, "after = (opacity >= 0.5)", "after = (opacity >= 0.05)", MEDIAN),
    of_host("masks are not minded", COARSE, "counts = middles[", "counts = ~counts & middles[",
            "training/test_coarse.py::test_pixels_that_do_not_count_are_not_looked_at"),
    of_host("near twice as far", COARSE, "< near * near", "< near",
            "training/test_coarse.py::test_nodes_nearer_than_the_near_plane_stay_empty"),
    # checkpoint.py
    of_host("grown is forgotten", CHECKPOINT, "        grown=grown,\n", "        grown=0,\n", COMES_BACK),
    of_host("no shift", CHECKPOINT, "density_shift=header.density_shift,", "density_shift=0.0,", COMES_BACK),
    of_host("moments are not looked at", KEPT, "            if not fits:\n", "            if False:\n", FORGED),
    of_host("more growths than there are", CHECKPOINT, "if not 0 <= grown <= most:", "if grown < 0:", FORGED),
    of_host("any optimiser", CHECKPOINT, "if not 0 <= training.restarted <= training.updates:", "if False:", FORGED),
    # presets.py
    of_host("dvgo: rate of density", "presets.py", "learning_rate_density=0.1", "learning_rate_density=1.0", PUBLISHED),
    of_host("dvgo: rays", "presets.py", "rays_per_step=8192", "rays_per_step=4096", PUBLISHED),
    of_host("dvgo: growths", "presets.py", "grow_at=(0.05, 0.1, 0.15, 0.2),", "grow_at=(0.05, 0.1, 0.15),", PUBLISHED),
    of_host("dvgo: jitter", "presets.py", "jitter=False", "jitter=True", PUBLISHED),
    of_host("dvgo: colours of samples", "presets.py", "loss=LossConfig(entropy=3e-3, sample_colour=3e-2),\n)",
            "loss=LossConfig(entropy=3e-3, sample_colour=1e-2),\n)", PUBLISHED),
    of_host("dvgo-unbounded: alpha_init", "presets.py", "alpha_init=1e-4,\n            contraction", "alpha_init=1e-3,\n            contraction", PUBLISHED),
    of_host("dvgo: alpha_init", "presets.py", "alpha_init=1e-4,\n    )", "alpha_init=1e-2,\n    )", PUBLISHED),
    of_host("dvgo: free space", "presets.py", "replace(_DVGO, alpha_min=1e-3)", "_DVGO", PUBLISHED),
    of_host("dvgo-unbounded: decay", "presets.py", "0.1**0.5", "0.1", PUBLISHED),
    of_host("dvgo-llff: total variation", "presets.py", "tv_density=4e-9", "tv_density=4e-8", PUBLISHED),
    of_host("dvgo-llff: least weight", "presets.py", "threshold=1e-3", "threshold=1e-4", PUBLISHED),
    of_host("fast: no distortion", "loss_config.py", "LossConfig(distortion=0.03, ", "LossConfig(", CHOSEN),
    of_host("fast: entropy", "loss_config.py", "entropy=1e-3, opacity", "entropy=1e-2, opacity", CHOSEN),
    of_host("quality: decay", "presets.py", "decay=0.03", "decay=0.3", CHOSEN),
]  # fmt: skip
