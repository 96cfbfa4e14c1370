"""Mutants of a hash: how it is read, and the way that its gradients take."""

from mutant import Mutant, of_host

FILE, PACKS, DECODER = "fields/hashed.py", "fields/hashed_packs.py", "fields/decoder.py"
HOST = "fields/hashed.py"
KINDS = "model/storage_kinds.py"
ORACLE = "kernels/test_hashed.py::test_against_the_oracle[kind0-0.3]"
FLAGS = "kernels/test_hashed.py::test_flags_are_those_of_pairs"
NODES = "kernels/test_hashed.py::test_densities_at_nodes_are_what_is_read_there[0.3-0]"
LAYER = "kernels/test_hashed.py::test_against_the_oracle[kind3-0.3]"
LAYER_NODES = "kernels/test_hashed.py::test_densities_at_nodes_are_what_is_read_there[0.3-32]"
SHAPES = "kernels/test_hashed.py::test_levels_lie_one_behind_the_other"
ACTIVE = "kernels/test_hashed.py::test_levels_are_read_as_the_lattice_grows"
PLAIN = "kernels/test_hashed_packed.py::test_packs_against_the_plain_form[rgb-none]"
OTHER = "kernels/test_hashed_packed.py::test_other_entries[deferred-2]"
LAYER_PACKS = "kernels/test_hashed_packed.py::test_a_hidden_layer[deferred-16-4]"
WIDE_LAYER = "kernels/test_hashed_packed.py::test_a_hidden_layer[many-48-2]"
SEVERAL = "kernels/test_hashed_packed.py::test_one_worker_against_more"
TILES = "kernels/test_hashed_packed.py::test_flags_cover_all_that_is_not_0"
TRAINING = "fields/test_hashed_training.py"
FREE = f"{TRAINING}::test_free_cells_are_those_of_less_opaque_nodes"
EPSILON = f"{TRAINING}::test_adam_has_an_epsilon_of_its_own"
LEARNS = f"{TRAINING}::test_a_hidden_layer_learns_and_is_kept"
COUNTS = f"{TRAINING}::test_a_hidden_layer_counts"
REFUSED = f"{TRAINING}::test_what_is_refused"

MUTANTS = [
    # the plain form
    Mutant("begin_of_row: a prime", "fields/hashed_packs.py", "805459861", "805459863", ORACLE),
    Mutant("begin_of_row: added, not xored", FILE, "of_i ^ (wp", "of_i + (wp", ORACLE),
    Mutant(
        "begin_of_row: levels on top of each other",
        FILE,
        "return level.begin + ",
        "return ",
        ORACLE,
    ),
    Mutant(
        "begin_of_row: rows of one's own by x alone", FILE, "(i * level.size[1] + j)", "i", ORACLE
    ),
    Mutant(
        "rows_around: rows along x for those along y",
        FILE,
        "begin_of_row(level, i, j + 1)",
        "begin_of_row(level, i + 1, j)",
        ORACLE,
    ),
    Mutant("share_of: x and y exchanged", FILE, "row >= 2", "row % 2 == 1", ORACLE),
    Mutant(
        "in_level: the lower entry alone",
        FILE,
        " + up * params.values[n + 1]\n        total",
        "\n        total",
        ORACLE,
    ),
    Mutant(
        "adj_in_level: all for the lower entry",
        FILE,
        "(real(1.0) - up) * share)",
        "share)",
        ORACLE,
    ),
    Mutant(
        "adj_in_level: one row not flagged",
        FILE,
        "gradient.touched[tile_of(n)]",
        "gradient.touched[tile_of(at.entries[0])]",
        FLAGS,
    ),
    Mutant(
        "read: the first level again",
        FILE,
        "params.levels[m], position))",
        "params.levels[0], position))",
        ORACLE,
        1,
        2,
    ),
    Mutant(
        "adj_read: one level's rows of the decoder for all",
        FILE,
        "row = (m * n_numbers + i) * stride",
        "row = i * stride",
        ORACLE,
        2,
        2,
    ),
    Mutant("read: units below 0, too", FILE, "unit = relu(before[u])", "unit = before[u]", LAYER),
    Mutant(
        "adj_read: of units below 0, too",
        FILE,
        "wp.where(unit > real(0.0), total, real(0.0))",
        "total",
        LAYER,
    ),
    Mutant(
        "adj_read: the decoder sees units before the ReLU",
        FILE,
        "unit * adj_raw[o])",
        "before[u] * adj_raw[o])",
        LAYER,
    ),
    Mutant(
        "density_of: units below 0, too",
        FILE,
        "(units[u] < 0 ? 0 : units[u])",
        "units[u]",
        LAYER_NODES,
    ),
    Mutant(
        "density_of: not the first column",
        FILE,
        "decoder.data[u * columns]",
        "decoder.data[u]",
        LAYER_NODES,
    ),
    Mutant(
        "hidden node_densities: one level",
        FILE,
        "numbers[m * n_numbers + i]",
        "numbers[i]",
        LAYER_NODES,
    ),
    Mutant(
        "node_densities: slabs begin at the first row",
        FILE,
        "(begin + row) // size[1]",
        "row // size[1]",
        f"{TRAINING}::test_densities_in_slabs",
        1,
        2,
    ),
    Mutant("node_densities: one level", FILE, "+= Density(raw)", "= Density(raw)", NODES),
    Mutant("node_densities: steps of the level", FILE, "u = real(k) * step", "u = real(k)", NODES),
    # packs
    Mutant("corners_of: a row's hash", PACKS, "row(2, x + X_PRIMEu, y)", "row(2, x, y)", PLAIN),
    Mutant(
        "corners_of: levels on top of each other", PACKS, "node[2] + level.begin", "node[2]", PLAIN
    ),
    Mutant(
        "corners_of: rows of one's own",
        PACKS,
        "(n / 2 * of_x + n % 2 * of_y)",
        "(n % 2 * of_x + n / 2 * of_y)",
        PLAIN,
    ),
    Mutant("corners_of: all stay", PACKS, "same &= node[axis] == before;", "", PLAIN),
    Mutant("corners_of: what is no sample may be left", PACKS, "& active & active << 1", "", PLAIN),
    Mutant(
        "read_pack: the corners of the next level",
        PACKS,
        "= corners[level % 2]",
        "= corners[(level + 1) % 2]",
        PLAIN,
    ),
    Mutant(
        "read_pack: the lower node alone",
        PACKS,
        "both.hi - both.lo, both.lo)",
        "both.lo - both.lo, both.lo)",
        PLAIN,
    ),
    Mutant(
        "add_level: all for the lower node",
        PACKS,
        "both.lo = adj - both.hi",
        "both.lo = adj",
        PLAIN,
    ),
    Mutant(
        "add_level: cells begin with what was before",
        PACKS,
        "begins ? pair_vec(0.0f) : sums[n]",
        "sums[n]",
        PLAIN,
    ),
    Mutant(
        "add_level: a cell's samples each by themselves",
        PACKS,
        "if (corners.stays >> (lane + 1) & 1) continue;",
        "",
        PLAIN,
    ),
    Mutant("add_pair: set, not added", PACKS, "*pair = *pair + sum", "*pair = sum", PLAIN),
    Mutant(
        "add_pair: not flagged",
        PACKS,
        "flags[(unsigned)entry / TILE] = 1;  //",
        "flags[0] = 1;  //",
        TILES + "[1]",
    ),
    Mutant(
        "add_between: not flagged",
        PACKS,
        "if (low || high) flags",
        "if (false) flags",
        TILES + "[8]",
    ),
    Mutant(
        "add_between: the upper entry by both",
        PACKS,
        "high = first <= entry + 1 &&",
        "high = first <= entry &&",
        SEVERAL + "[8]",
    ),
    Mutant(
        "add_between: the lower entry alone",
        PACKS,
        "if (high) one[1]",
        "if (false) one[1]",
        SEVERAL + "[8]",
    ),
    Mutant(
        "add_level: parts without the last",
        PACKS,
        "/ parts / TILE + 1) * TILE",
        "/ parts / TILE) * TILE - TILE",
        SEVERAL + "[8]",
    ),
    Mutant(
        "owner_of: levels of no one",
        PACKS,
        "n_workers - 1 - place : place",
        "n_workers - place : place",
        SEVERAL + "[2]",
    ),
    Mutant(
        "own_after: the first alone",
        PACKS,
        "while (++level < n_active)",
        "while (++level < 1)",
        SEVERAL + "[2]",
    ),
    Mutant(
        "adj_read_pack: no record",
        PACKS,
        "if (n_workers == 1 || !n_rows) return;",
        "return;",
        SEVERAL + "[2]",
    ),
    Mutant(
        "records: one's own as well", PACKS, "if (sender == worker) return;", "", SEVERAL + "[2]"
    ),
    Mutant(
        "records: the first of them again",
        PACKS,
        "(const float*)&records[k]",
        "(const float*)&records[0]",
        SEVERAL + "[2]",
    ),
    Mutant(
        "records: corners of the one before",
        PACKS,
        "add_level(corners[here]",
        "add_level(corners[next]",
        SEVERAL + "[2]",
    ),
    Mutant(
        "records: half of the numbers",
        PACKS,
        "n < n_inputs; n += LANES",
        "n < LANES; n += LANES",
        SEVERAL + "[2]",
    ),
    Mutant("begin: not transposed", DECODER, "to[o * padded + n]", "to[n * n_numbers + o]", PLAIN),
    Mutant(
        "begin: one matrix on top of the other",
        DECODER,
        "to += n_numbers * padded;",
        ";",
        LAYER_PACKS,
    ),
    Mutant(
        "hidden layer: units below 0, too",
        PACKS,
        "before < 0.0f ? splat(0.0f) : before",
        "before",
        LAYER_PACKS,
    ),
    Mutant(
        "hidden layer, back: of units below 0, too",
        PACKS,
        "at(units_of(r) + block) > 0.0f ? at(adj) : splat(0.0f)",
        "at(adj)",
        LAYER_PACKS,
    ),
    Mutant(
        "hidden layer, back: the other matrix",
        PACKS,
        "transposed + HIDDEN * PADDED + block",
        "transposed + block",
        LAYER_PACKS,
    ),
    Mutant(
        "hidden layer, back: some of the units",
        PACKS,
        "add_products(n_rows, HIDDEN, units_of",
        "add_products(n_rows, LANES, units_of",
        WIDE_LAYER,
    ),
    Mutant(
        "add_products: more inputs than there are", DECODER, "if (n < n_here) put", "put", OTHER
    ),
    # the host
    of_host(
        "limits of a hidden layer", HOST, "sqrt(6.0 / n_inputs)", "sqrt(3.0 / n_inputs)", LEARNS
    ),
    of_host("limits of its decoder", HOST, "sqrt(3.0 / n_rows)", "sqrt(3.0 / n_inputs)", LEARNS),
    of_host("a layer takes no time", KINDS, " + LAYER_TIME * of_layer", "", COUNTS),
    of_host("a layer takes no memory", KINDS, " + self.levels * self.hidden", "", COUNTS),
    of_host("any number of units", KINDS, "self.hidden % 16 or self", "self", REFUSED),
    of_host("as many units as one likes", KINDS, " or self.hidden > MAX_WIDTH", "", REFUSED),
    of_host(
        "rows at the table's end",
        HOST,
        "kind.table + z if is_hashed",
        "kind.table if is_hashed",
        SHAPES,
    ),
    of_host("levels begin anywhere", HOST, "-(-end // ALIGNED) * ALIGNED", "end + 1", SHAPES),
    of_host("all levels from the start", HOST, "max(1.0, wider)", "1.0", ACTIVE),
    of_host("another box", HOST, 'raise ValueError("the box of a hash is fixed")', "pass", ACTIVE),
    of_host(
        "nodes bound what lies between",
        "fields/occupancy.py",
        "storage.kind.seen_share * alpha_min",
        "alpha_min",
        FREE,
    ),
    of_host(
        "one epsilon for all",
        "training/optim.py",
        "config.epsilon if epsilon is None else epsilon",
        "config.epsilon",
        EPSILON,
    ),
]
