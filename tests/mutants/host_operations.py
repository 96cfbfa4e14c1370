"""Mutants of what operations of torch render besides dense grids, and of what they refuse."""

from mutant import of_host

TESTS = "torch_operations/test_stored_fields.py::"
ORACLE = f"{TESTS}test_stored_fields_against_the_oracle"
INTERVALS = f"{TESTS}test_intervals_of_stored_fields_against_the_oracle"
ALIKE = f"{TESTS}test_intervals_that_are_steps_are_steps"
FIELDS = f"{TESTS}test_bad_fields_are_refused"
EDGES = f"{TESTS}test_bad_edges_are_refused"
IN_PLACE = f"{TESTS}test_what_changes_in_place_is_noticed"
TOO_MUCH = f"{TESTS}test_bad_first_tensors_are_refused"
BOXES = f"{TESTS}test_bad_boxes_are_refused"
OTHER = f"{TESTS}test_other_forms_of_the_same"
OF_JAX = "jax_operations/test_stored_fields.py::test_they_are_those_of_torch"
EDGES_OF_JAX = "jax_operations/test_stored_fields.py::test_bad_edges_are_refused"
ARGUMENTS, JAX = "rendering/arguments.py", "jax/launches.py"
FIRST = f"{TESTS}test_first_tensors_are_those_of_a_training"
OPERATION, STORED = "rendering/operation.py", "rendering/stored.py"
RENDERING = "torch/rendering.py"

MUTANTS = [
    of_host("operation: levels for another lattice", OPERATION, ".as_final()", "", ORACLE),
    of_host("operation: the first row alone", OPERATION, "[:, :n].sum", "[:1, :n].sum", ORACLE),
    of_host(
        "operation: rows that are not summed",
        OPERATION,
        "_sum_rows(getattr(gradient, name), array)",
        "pass",
        ORACLE,
    ),
    of_host(
        "operation: weights are not kept",
        OPERATION,
        "weights=interval_weights",
        "weights=wp.empty((0, 0), dtype=self.types.real)",
        INTERVALS,
    ),
    of_host(
        "operation: intervals are steps",
        OPERATION,
        "if not self.n_intervals:",
        "if True:",
        INTERVALS,
    ),
    of_host(
        "operation: weights with a gradient",
        "torch/launches.py",
        "ctx.mark_non_differentiable(interval_weights)",
        "pass",
        ALIKE,
    ),
    of_host(
        "operation: no first tensors but those of seed 0",
        STORED,
        "layout.lattice, seed, cpu",
        "layout.lattice, 0, cpu",
        FIRST,
    ),
    of_host(
        "operation: any shapes", STORED, "if tuple(shape) != expected.shape:", "if False:", FIELDS
    ),
    of_host("operation: one node is enough", STORED, "if min(x, y, z) < 2 or", "if", FIELDS),
    of_host("operation: a hash with a size", STORED, "if size is not None:", "if False:", TOO_MUCH),
    of_host(
        "operation: edges that fall",
        RENDERING,
        "(given[:, 1:] >= given[:, :-1]).all() and",
        "",
        EDGES,
    ),
    of_host(
        "operation: edges behind the camera",
        RENDERING,
        " and (given[:, 0] >= 0.0).all()",
        "",
        EDGES,
    ),
    of_host(
        "operation: edges that are not finite",
        RENDERING,
        "bool(given.isfinite().all()) and bool(rising)",
        "bool(rising)",
        EDGES,
    ),
    of_host(
        "operation: edges of other rays",
        "rendering/arguments.py",
        " or shape[0] != n_rays",
        "",
        EDGES,
    ),
    of_host(
        "operation: a single interval",
        "rendering/arguments.py",
        "not 2 <= shape[1] - 1 <= MOST",
        "shape[1] - 1 > MOST",
        EDGES,
    ),
    of_host(
        "operation: tensors that are not watched",
        "torch/launches.py",
        "ctx.save_for_backward(*outputs, *given)",
        "ctx.save_for_backward(*outputs, *(x.clone() for x in given))",
        IN_PLACE,
    ),
    of_host(
        "operation: a box of any size",
        ARGUMENTS,
        " or np.abs(array).max() > MAX_COORDINATE",
        "",
        BOXES,
    ),
    of_host(
        "operation: a box of no size",
        ARGUMENTS,
        "if not (lower < upper).all():",
        "if False:",
        BOXES,
    ),
    of_host("operation: dense is no stored field", STORED, "if name != DENSE.name", "", FIELDS),
    of_host(
        "operation: used up without a word",
        ARGUMENTS,
        'used_up = "" if found else',
        'used_up = "" if True else',
        OTHER,
    ),
    of_host(
        "operation: first tensors use a head up",
        STORED,
        "model = model_in(head)",
        "model = model_in(head); list(getattr(head, 'layers', ()))",
        OTHER,
    ),
    of_host(
        "operation, JAX: weights that are not zeroed",
        JAX,
        "interval_weights.zero_()",
        "interval_weights.fill_(1.0)",
        OF_JAX,
    ),
    of_host(
        "operation, JAX: gradients that are not zeroed",
        JAX,
        "            gradient.zero_()",
        "            gradient.fill_(1.0)",
        OF_JAX,
    ),
    of_host(
        "operation, JAX: edges that fall",
        JAX,
        "(edges[:, 1:] >= edges[:, :-1]).all() and",
        "",
        EDGES_OF_JAX,
    ),
]
