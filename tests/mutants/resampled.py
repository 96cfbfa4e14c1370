"""Mutants of what is resampled: histograms, edges drawn from them, the bound and its adjoint."""

from mutant import Mutant, of_host

DRAWN = "kernels/test_proposal.py::test_histograms_and_edges_against_the_oracle"
NEAR_0, ANNEALED = f"{DRAWN}[near 0-linf]", f"{DRAWN}[annealed-box]"
VECTOR = "kernels/test_proposal.py::test_the_vector_form_equals_the_plain_one[linf]"
BOUND = "kernels/test_proposal.py::test_the_bound_and_its_gradient_against_the_oracle[near 0-linf]"
PARTS = "kernels/test_proposal.py::test_the_gradient_is_the_same_however_many_add_it[linf]"
ALIKE = "kernels/test_resampled_steps.py::test_intervals_that_are_alike_are_steps_at_given_distances[linf]"
WALKED = "kernels/test_resampled_steps.py::test_the_vector_form_equals_the_plain_one[1-linf]"
KEPT = "kernels/test_resampled_steps.py::test_what_samples_weigh_is_kept[none]"
FREE = "kernels/test_resampled_steps.py::test_what_is_free_depends_on_no_interval"
IN_PACKS = "kernels/test_gradient_check.py::test_the_proposal_s_gradient_in_packs"
LEARNS = "training/test_resampling.py::test_the_proposal_learns_to_bound"
DUE = (
    "training/test_resampling.py::test_a_proposal_learns_every_few_updates_once_it_is_not_flattened"
)
GROWN = "training/test_resampling.py::test_a_proposal_grows_into_the_box_of_its_field"
RESUMED = "training/test_resampling.py::test_a_training_goes_on_with_equal_bits"
PIECES = "training/test_resampling.py::test_a_field_comes_back_with_its_proposal"
UNIT = "training/test_resampling.py::test_bins_are_equally_long_near_cameras_unless_there_is_a_near_plane"

MUTANTS = [
    # sampling/resampled.py
    Mutant(
        "bins: length of the one before",
        "sampling/resampled.py",
        "real(bins.n - k - 1) * width",
        "real(bins.n - k + 1) * width",
        NEAR_0,
    ),
    Mutant(
        "place_bins: a lane off",
        "sampling/resampled.py",
        "to_float(bins.n - k) * width",
        "to_float(bins.n - k - 1) * width",
        VECTOR,
    ),
    Mutant(
        "blurred: the bin before twice",
        "sampling/resampled.py",
        "weights[ray, wp.min(k + 1, n - 1)]",
        "weights[ray, wp.max(k - 1, 0)]",
        NEAR_0,
    ),
    Mutant(
        "blurred: padding",
        "sampling/resampled.py",
        "real(wp.static(PADDING)) / real(n)",
        "real(wp.static(PADDING))",
        NEAR_0,
    ),
    Mutant(
        "annealed twice",
        "sampling/resampled.py",
        "wp.pow(here, anneal)",
        "wp.pow(here, anneal * anneal)",
        ANNEALED,
    ),
    Mutant(
        "edges: share of the bin before",
        "sampling/resampled.py",
        "(wanted - before) / mass[ray, k]",
        "(wanted - before) / total",
        NEAR_0,
    ),
    Mutant(
        "edges, packed: mass of no bin counts",
        "sampling/resampled.py",
        "before += heights[k++]",
        "before += 0.0f * heights[k++]",
        VECTOR,
    ),
    Mutant(
        "edges, packed: the bin after is the bin",
        "sampling/resampled.py",
        "k + n : k + n + 1]",
        "k + n : k + n]",
        VECTOR,
    ),
    Mutant(
        "bound: not over the weight",
        "sampling/resampled.py",
        "return above * above / (weight + real(wp.static(EPSILON)))",
        "return above * above",
        BOUND,
    ),
    Mutant(
        "adj_bound: sign",
        "sampling/resampled.py",
        "real(-2.0) * adj_loss",
        "real(2.0) * adj_loss",
        BOUND,
    ),
    Mutant(
        "interval_after: one late",
        "sampling/resampled.py",
        "low = middle + 1",
        "low = middle + 2",
        ALIKE,
    ),
    Mutant(
        "intervals: length to the one after next",
        "sampling/resampled.py",
        "intervals.edges[ray.index, k + 1] - begin",
        "intervals.edges[ray.index, k + 1] - real(0.9) * begin",
        ALIKE,
    ),
    Mutant(
        "place_intervals: the row of another ray",
        "sampling/resampled.py",
        "(size_t)ray.index * (last + 1);",
        "(size_t)0 * (last + 1);",
        WALKED,
    ),
    Mutant(
        "keep_weight: a step off",
        "sampling/resampled.py",
        "intervals.out_weights[ray.index, step] = weight",
        "intervals.out_weights[ray.index, wp.max(step - 1, 0)] = weight",
        KEPT,
    ),
    Mutant(
        "keep_weights: a lane off",
        "sampling/resampled.py",
        "row[pack.step + n] = pack.weight.c[n]",
        "row[pack.step + n] = pack.weight.c[0]",
        WALKED,
    ),
    Mutant(
        "free cells by one step",
        "sampling/resampled.py",
        "return longest_step(intervals.march, boxes_out)",
        "return intervals.march.step",
        FREE,
    ),
    # launch/propose.py
    Mutant(
        "add_planes: y's share for x",
        "launch/propose.py",
        "wp.abs(u[0] - real(i))",
        "wp.abs(u[1] - real(j))",
        BOUND,
    ),
    Mutant(
        "add_planes: a plane too many",
        "launch/propose.py",
        "begin <= i and i < end",
        "begin <= i and i <= end",
        PARTS,
    ),
    Mutant(
        "read_bins: columns swapped",
        "launch/propose.py",
        "column(2, node + stride_y);",
        "column(2, node + stride_x);",
        VECTOR,
    ),
    Mutant(
        "keep_bins: light before the bin",
        "launch/propose.py",
        "load(pack.sigma_slope) * load(pack.dt)",
        "load(pack.sigma_slope)",
        IN_PACKS,
    ),
    Mutant(
        "bins: light of none",
        "launch/propose.py",
        "histograms.light[i, k] * adj_weight - suffix_sum",
        "adj_weight - suffix_sum",
        BOUND,
    ),
    Mutant(
        "bins: no suffix sum",
        "launch/propose.py",
        "suffix_sum += histograms.weights[i, k] * adj_weight",
        "suffix_sum += real(0.0)",
        BOUND,
    ),
    Mutant(
        "bound: without the last bin",
        "launch/propose.py",
        "bin_at(bins, ends, edges[i, n + 1]) + 1",
        "bin_at(bins, ends, edges[i, n + 1])",
        BOUND,
    ),
    # the walk
    Mutant(
        "walk: weights are not kept",
        "volume/walk.py",
        "keep(scene.march, ray, sample.step, weight)",
        "keep(scene.march, ray, sample.step, real(0.0))",
        KEPT,
    ),
    # the host
    of_host(
        "a proposal learns in every update",
        "model/sampler_kinds.py",
        "update % self.update_every == 0",
        "update >= 0",
        DUE,
    ),
    of_host(
        "a proposal stays where it was",
        "training/resampling.py",
        "    grown = proposal.resized(lattice.space, workers)",
        "    grown = proposal.resized(proposal.grid.lattice.space, workers)",
        GROWN,
    ),
    of_host(
        "a resumed proposal restarts",
        "rendering/proposal.py",
        "return replace(self, grid=self.grid.copied_to(device))",
        "grid = self.grid.copied_to(device)\n        grid.values.zero_()\n"
        "        return replace(self, grid=grid)",
        RESUMED,
    ),
    of_host(
        "all pieces of a picture are the first",
        "rendering/field.py",
        "seen.write(begin, self._walk",
        "seen.write(0 * begin, self._walk",
        PIECES,
    ),
    of_host(
        "near planes change no bins",
        "rendering/proposal.py",
        "content_distance if near == 0.0 else 0.0",
        "content_distance",
        UNIT,
    ),
]
