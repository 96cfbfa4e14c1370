"""Mutants of factors: how they are read, and the way that their gradients take."""

from mutant import Mutant

FILE, PACKS, TERMS = "fields/factors.py", "fields/factor_packs.py", "optim/factor_terms.py"
DECODER = "fields/decoder.py"
ORACLE = "kernels/test_factors.py::test_against_the_oracle"
FLAGS = "kernels/test_factors.py::test_flags_are_those_of_pairs"
PLAIN = "kernels/test_factors_packed.py::test_packs_against_the_plain_form[rgb-none]"
BY_SAMPLE = "kernels/test_factors_packed.py::test_packs_against_the_plain_form[many-none]"
WIDE = "kernels/test_factors_packed.py::test_wide_entries[deferred]"
SEVERAL = "kernels/test_factors_packed.py::test_one_worker_against_more"
TILES = "kernels/test_factors_packed.py::test_flags_cover_all_that_is_not_0"
TRAINING = "fields/test_factors_training.py"
NODES = f"{TRAINING}::test_densities_at_nodes"
GROWTH = f"{TRAINING}::test_growth_reads_at_new_places"
MOMENTS = f"{TRAINING}::test_growth_carries_moments_over"
REGULARISERS = f"{TRAINING}::test_regularisers_are_slopes_of_their_sums"

MUTANTS = [
    # the plain form
    Mutant(
        "corner_of: rows of the plane yz", FILE, "a = wp.where(plane == 2, 1, 0)", "a = 0", ORACLE
    ),
    Mutant(
        "corner_of: row of the plane xy", FILE, "b = wp.where(plane == 0, 1, 2)", "b = 2", ORACLE
    ),
    Mutant(
        "corner_of: the plane xz begins late",
        FILE,
        "size[1] + wp.where(plane == 1, 0, size[2])",
        "size[1] + size[2]",
        ORACLE,
    ),
    Mutant(
        "corner_of: the line y begins at 0",
        FILE,
        "at.line = wp.where(plane == 0, 0,",
        "at.line = wp.where(plane < 2, 0,",
        ORACLE,
    ),
    Mutant(
        "in_plane: rows exchanged",
        FILE,
        "(real(1.0) - at.across) * low + at.across * high",
        "at.across * low + (real(1.0) - at.across) * high",
        ORACLE,
    ),
    Mutant(
        "on_line: the lower entry alone",
        FILE,
        "+ at.up * params.lines[low + params.width]",
        "",
        ORACLE,
    ),
    Mutant(
        "read: one plane's rows of the decoder for all",
        FILE,
        "row = (plane * width + n) * columns",
        "row = n * columns",
        ORACLE,
        1,
        2,
    ),
    Mutant(
        "adj_read: one plane's rows of the decoder for all",
        FILE,
        "row = (plane * width + n) * columns",
        "row = n * columns",
        ORACLE,
        2,
        2,
    ),
    Mutant(
        "adj_read: decoder by the plane alone",
        FILE,
        "around[n] * line * adj_raw[o]",
        "around[n] * adj_raw[o]",
        ORACLE,
    ),
    Mutant(
        "adj_read: line by itself", FILE, "adj_product * around[n]", "adj_product * line", ORACLE
    ),
    Mutant(
        "adj_read: plane without its line",
        FILE,
        "adj[n] = adj_product * line",
        "adj[n] = adj_product",
        ORACLE,
    ),
    Mutant("adj_in_plane: rows alike", FILE, "low = adj - high", "low = adj", ORACLE),
    Mutant(
        "adj_in_plane: the upper row not flagged",
        FILE,
        "    gradient.touched[tile_of(n + at.row)] = wp.uint8(1)\n",
        "",
        FLAGS,
    ),
    # packs
    Mutant("corners_of: the wrong line", PACKS, "c = 2 - plane;", "c = plane;", PLAIN),
    Mutant(
        "in_plane: the lower row twice", PACKS, "low + (size_t)corners.row * WIDTH", "low", PLAIN
    ),
    Mutant(
        "on_line: the upper entry alone",
        PACKS,
        "fma(splat(corners.up[lane]), at(low + WIDTH) - at(low), at(low))",
        "at(low + WIDTH)",
        PLAIN,
    ),
    Mutant(
        "read_pack: the first block alone",
        PACKS,
        "in_plane(corners, lane_of[r], block)",
        "in_plane(corners, lane_of[r], 0)",
        WIDE,
    ),
    Mutant(
        "put_raw: samples in the lanes of others",
        DECODER,
        "by_lane[lane_of[r]]",
        "by_lane[r]",
        PLAIN,
    ),
    Mutant(
        "put_raw: by sample in the lanes of others",
        DECODER,
        "pack.by_sample.data[lane_of[r]]",
        "pack.by_sample.data[r]",
        BY_SAMPLE,
    ),
    Mutant(
        "add_pair: set, not added",
        PACKS,
        "fma(splat(second), adj, at(to + WIDTH))",
        "second * adj",
        PLAIN,
    ),
    Mutant(
        "add_pair: not flagged",
        PACKS,
        "flags[(unsigned)entry / TILE] = 1",
        "flags[0] = 1",
        TILES + "[1]",
    ),
    Mutant("add_plane: line's lower entry gets all", PACKS, "(adj_line - high)", "adj_line", PLAIN),
    Mutant(
        "add_plane: the upper row's shares",
        PACKS,
        "corners.shares[2][lane]",
        "corners.shares[0][lane]",
        PLAIN,
        2,
        2,
    ),
    Mutant("add_plane: another's adjoint", PACKS, "adj_raw[lane_of[r]]", "adj_raw[r]", PLAIN),
    Mutant(
        "add_plane: lines and decoder by both owners",
        PACKS,
        "if (is_lower)",
        "if (true)",
        SEVERAL + "[3]",
    ),
    Mutant(
        "add_products: the first inputs for all",
        DECODER,
        "x_of(r) + begin;",
        "x_of(r);",
        WIDE,
    ),
    Mutant("owned: rows end one late", PACKS, "(node < end)", "(node <= end)", SEVERAL + "[2]"),
    Mutant(
        "owned: rows begin one late", PACKS, "(begin <= node)", "(begin < node)", SEVERAL + "[2]"
    ),
    Mutant(
        "owned: rows rounded down",
        PACKS,
        "(n + n_workers - 1) / n_workers",
        "n / n_workers",
        SEVERAL + "[3]",
    ),
    Mutant(
        "owned: rows of x for all planes",
        PACKS,
        "n = size.c[first_axis[plane]], rows",
        "n = size.c[0], rows",
        SEVERAL + "[2]",
    ),
    Mutant("adj_read_pack: no record", PACKS, "if (all_mine) return;", "return;", SEVERAL + "[2]"),
    Mutant(
        "adj_read_pack: a record only where no row is one's own",
        PACKS,
        "all_mine &= (lower & upper) == active",
        "all_mine &= (lower | upper) == active",
        SEVERAL + "[3]",
    ),
    Mutant(
        "records: for the sender",
        PACKS,
        "receiver == worker ||",
        "receiver != worker ||",
        SEVERAL + "[2]",
    ),
    Mutant(
        "add_records: the first of them again",
        PACKS,
        "records[which[k] / 8]",
        "records[which[0] / 8]",
        SEVERAL + "[2]",
    ),
    Mutant(
        "add_records: planes of x alone",
        PACKS,
        "each(which[k] & 7",
        "each(which[k] & 3",
        SEVERAL + "[2]",
    ),
    Mutant(
        "begin: not transposed",
        "fields/decoder.py",
        "to[o * padded + n]",
        "to[n * COLUMNS + o]",
        PLAIN,
    ),
    # densities, growth, regularisers
    Mutant(
        "node_densities: the line z for y",
        FILE,
        "on_node(params, size[2] + j)",
        "on_node(params, j)",
        NODES,
    ),
    Mutant(
        "node_densities: slabs begin at the first row",
        FILE,
        "params.planes[begin + row]",
        "params.planes[row]",
        NODES,
    ),
    Mutant(
        "resample: the lower entry",
        FILE,
        "share * values[low + inner]",
        "share * values[low]",
        GROWTH,
    ),
    Mutant(
        "place_along: no offset",
        "fields/interp.py",
        "* scale + offset, real(0.0), last)",
        "* scale, real(0.0), last)",
        GROWTH,
    ),
    Mutant(
        "place_along: outer rows",
        "fields/interp.py",
        "(n // (inner * out_size)) * size",
        "(n // (inner * out_size)) * out_size",
        GROWTH,
    ),
    Mutant(
        "blend_moments: the mean of the lower",
        "optim/adam.py",
        "(1.0f - share) * mean_of(a) + share * mean_of(b)",
        "mean_of(a)",
        MOMENTS,
    ),
    Mutant(
        "plane_terms: neighbours across planes",
        TERMS,
        "if i + 1 < n_rows:",
        "if n + row < on.planes.shape[0]:",
        REGULARISERS,
    ),
    Mutant(
        "plane_terms: neighbours across rows",
        TERMS,
        "if j + 1 < row:",
        "if n + 1 < on.planes.shape[0]:",
        REGULARISERS,
    ),
    Mutant(
        "plane_terms: where no ray was", TERMS, "if not (adj == Entry()):", "if True:", REGULARISERS
    ),
    Mutant(
        "plane_terms: one plane's count for all",
        TERMS,
        "on.magnitude[plane]",
        "on.magnitude[0]",
        REGULARISERS,
    ),
    Mutant("line_terms: all numbers", TERMS, "n % width < n_sparse and got", "got", REGULARISERS),
    Mutant("line_terms: where no ray was", TERMS, "and got != real(0.0) and", "and", REGULARISERS),
]
