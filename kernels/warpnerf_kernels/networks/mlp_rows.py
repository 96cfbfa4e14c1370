"""SIMD MLP, the vector form in C++: rows through its layers and back, a few at a time.

The units of a row lie side by side in vectors, so that a layer takes several rows through each
vector of weights that it loads. How weights lie, mlp.py says; the way back reads a copy of them in
which rows and columns are exchanged.
"""

from ..base.simd import VECTORS


def prelude_of(**constants: int) -> str:
    """C++ of the vector form: transpose(), forward() and backward() on rows.

    Args:
        constants: Of a layout: INPUTS (a row's own), WIDTH, HIDDEN (layers), AT_BIASES, AT_HIDDEN,
            AT_OUTPUT and OUTPUTS.
    """
    listed = ", ".join(f"{name} = {value}" for name, value in constants.items())
    return VECTORS + f"constexpr int {listed};\n" + ROWS


ROWS = r"""
typedef float float4_at __attribute__((ext_vector_type(4), aligned(4), may_alias));
constexpr int PADDED = (INPUTS + LANES - 1) / LANES * LANES;  // inputs in whole vectors
constexpr int LAYER = WIDTH * WIDTH + WIDTH;
// Rows, and vectors of units, that are worked on together: as many sums as registers hold. Sums are
// formed row by row, so that results do not depend on how many.
#ifdef __AVX512F__
constexpr int MAX_ROWS = 8, MAX_VECS = 2;
#else
constexpr int MAX_ROWS = 4, MAX_VECS = 1;
#endif
struct Few { enum { value = 4 }; };
struct Many { enum { value = MAX_ROWS }; };
struct Several { enum { value = WIDTH % (MAX_VECS * LANES) ? 1 : MAX_VECS }; };  // of a layer
struct Inputs { enum { value = PADDED % (MAX_VECS * LANES) ? 1 : MAX_VECS }; };
// Rows that go through a layer before any goes through the next: its columns of weights stay in
// L1 meanwhile. Arrays have an entry for each, as the last block may reach beyond the rows that
// there are.
constexpr int GROUP = 32, MAX_BLOCKS = GROUP / Few::value;
static_assert(GROUP % Many::value == 0, "a block reaches beyond the group");
auto by_groups = [&](int n, auto visit) {
    for (int begin = 0; begin < n; begin += GROUP) visit(begin, min(GROUP, n - begin));
};
auto by_blocks = [&](int n, auto visit) {
    for (int begin = 0, block = 0; begin < n; ++block) {
        if (n - begin > Few::value) visit(Many(), begin, block), begin += Many::value;
        else visit(Few(), begin, block), begin += Few::value;
    }
};
auto at = [&](const float* x) -> vec { return *(const vec_at*)x; };
auto put = [&](float* x, vec v) { *(vec_at*)x = v; };
// Of the output layer a vector holds the weights of four units. To go with it, units four times
// each, and outputs four times in a row.
auto units_four_times = [&](const float* h) -> vec {
    const float4 q = *(const float4_at*)h;
    return __builtin_shufflevector(q, q, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
};
auto outputs_four_times = [&](float4 q) -> vec {
    return __builtin_shufflevector(q, q, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
};
// What of a block's inputs is looked at: all, or the units that at least one of its rows has above
// 0. Neighbouring samples share them, so ReLU saves a third to two thirds of the work.
struct Every { int n; int operator[](int k) const { return k; } };
struct ActiveUnits { int n; int units[WIDTH]; int operator[](int k) const { return units[k]; } };
const Every every_input = {INPUTS};
auto all_inputs = [&](int) -> const Every& { return every_input; };
auto find_active = [&](int n, const float* const* h, ActiveUnits* active) {
    by_blocks(n, [&](auto rows, int begin, int block) {
        ActiveUnits& found = active[block];
        int n_found = 0;
        for (int u = 0; u < WIDTH; u += LANES) {
            ivec any = ivec(0);
            #pragma clang loop unroll(full)
            for (int b = 0; b < decltype(rows)::value; ++b) any |= at(h[begin + b] + u) != 0.0f;
            n_found += list_lanes(bits(any), u, found.units + n_found);
        }
        found.n = n_found;
    });
};

// The weights with rows and columns exchanged, for the way back.
auto transpose = [&](const float* w, float* t) {
    for (int j = 0; j < WIDTH; ++j) {
        for (int i = 0; i < PADDED; ++i) *t++ = i < INPUTS ? w[i * WIDTH + j] : 0.0f;
    }
    for (int layer = 0; layer + 1 < HIDDEN; ++layer) {
        const float* from = w + AT_HIDDEN + layer * LAYER;
        for (int j = 0; j < WIDTH; ++j) {
            for (int i = 0; i < WIDTH; ++i) *t++ = from[i * WIDTH + j];
        }
    }
    for (int o = 0; o < 3; ++o) {
        for (int i = 0; i < WIDTH; ++i) *t++ = w[AT_OUTPUT + OUTPUTS * i + o];
    }
};
// out[b][:] = act(first_of(b)[:] + sum_i x[b][i] w[i][:]) for n rows, `units` numbers each;
// inputs_of(block): over which i.
auto multiply = [&](int n, const float* w, auto inputs_of, int units, auto step,
                    const float* const* x, auto first_of, float* const* out, auto act) {
    constexpr int AT_ONCE = decltype(step)::value;
    for (int u = 0; u < units; u += AT_ONCE * LANES) {
        by_blocks(n, [&](auto rows, int begin, int block) {
            constexpr int N = decltype(rows)::value;
            const float* from[N];
            vec sum[N][AT_ONCE];
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                from[b] = x[begin + b];
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) sum[b][v] = first_of(begin + b, u + v * LANES);
            }
            const auto& inputs = inputs_of(block);
            const int n_inputs = inputs.n;
            for (int k = 0; k < n_inputs; ++k) {
                const int i = inputs[k];
                vec row[AT_ONCE];
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) row[v] = at(w + i * units + u + v * LANES);
                #pragma clang loop unroll(full)
                for (int b = 0; b < N; ++b) {
                    #pragma clang loop unroll(full)
                    for (int v = 0; v < AT_ONCE; ++v) {
                        sum[b][v] = fma(splat(from[b][i]), row[v], sum[b][v]);
                    }
                }
            }
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) {
                    put(out[begin + b] + u + v * LANES, act(sum[b][v], begin + b, u + v * LANES));
                }
            }
        });
    }
};
// w[i][:] += sum_b x[b][i] adj[b][:], and biases[:] += sum_b adj[b][:].
auto add_outer = [&](int n, float* w, float* biases, auto inputs_of, const float* const* x,
                     const float* const* adj) {
    constexpr int AT_ONCE = Several::value;
    for (int u = 0; u < WIDTH; u += AT_ONCE * LANES) {
        by_blocks(n, [&](auto rows, int begin, int block) {
            constexpr int N = decltype(rows)::value;
            const float* from[N];
            vec a[N][AT_ONCE];
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) from[b] = x[begin + b];
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) {
                vec sum = at(biases + u + v * LANES);
                #pragma clang loop unroll(full)
                for (int b = 0; b < N; ++b) sum += a[b][v] = at(adj[begin + b] + u + v * LANES);
                put(biases + u + v * LANES, sum);
            }
            const auto& inputs = inputs_of(block);
            const int n_inputs = inputs.n;
            for (int k = 0; k < n_inputs; ++k) {
                const int i = inputs[k];
                float* to = w + i * WIDTH + u;
                vec sum[AT_ONCE];
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) sum[v] = at(to + v * LANES);
                #pragma clang loop unroll(full)
                for (int b = 0; b < N; ++b) {
                    #pragma clang loop unroll(full)
                    for (int v = 0; v < AT_ONCE; ++v) {
                        sum[v] = fma(splat(from[b][i]), a[b][v], sum[v]);
                    }
                }
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) put(to + v * LANES, sum[v]);
            }
        });
    }
};
auto zero = [&](int, int) -> vec { return splat(0.0f); };
auto as_is = [&](vec x, int, int) -> vec { return x; };
auto relu = [&](vec x, int, int) -> vec { return x < 0.0f ? splat(0.0f) : x; };  // keeps a NaN
// Rows 0 to n - 1: x_of(r) their inputs, first_of(r) what the first layer begins with, h_of(r) room
// for all hidden units, y_of(r) room for four outputs.
auto forward = [&](int n, const float* w, auto x_of, auto first_of, auto h_of, auto y_of) {
    by_groups(n, [&](int group, int some) {
        const float *x[GROUP], *first[GROUP];
        float* h[GROUP];
        float unused[HIDDEN * WIDTH];
        for (int b = 0; b < GROUP; ++b) {
            const int r = group + min(b, some - 1);
            x[b] = x_of(r), first[b] = first_of(r);
            h[b] = b < some ? h_of(r) : unused;
        }
        const auto given = [&](int b, int u) -> vec { return at(first[b] + u); };
        multiply(some, w, all_inputs, WIDTH, Several(), x, given, h, relu);
        for (int layer = 1; layer < HIDDEN; ++layer) {
            const float* from = w + AT_HIDDEN + (layer - 1) * LAYER;
            const float* below[GROUP];
            for (int b = 0; b < GROUP; ++b) below[b] = h[b], h[b] += WIDTH;
            ActiveUnits active[MAX_BLOCKS];
            find_active(some, below, active);
            const auto active_of = [&](int block) -> auto& { return active[block]; };
            const auto biases = [&](int, int u) -> vec { return at(from + WIDTH * WIDTH + u); };
            multiply(some, from, active_of, WIDTH, Several(), below, biases, h, relu);
        }
        const float* last = w + AT_OUTPUT;
        const float4 biases = *(const float4_at*)(last + OUTPUTS * WIDTH);
        by_blocks(some, [&](auto rows, int begin, int) {
            constexpr int N = decltype(rows)::value;
            vec sums[N];
            for (int b = 0; b < N; ++b) sums[b] = splat(0.0f);
            for (int i = 0; i < WIDTH; i += 4) {
                const vec four = at(last + OUTPUTS * i);
                #pragma clang loop unroll(full)
                for (int b = 0; b < N; ++b) {
                    sums[b] = fma(units_four_times(h[begin + b] + i), four, sums[b]);
                }
            }
            for (int b = 0; b < N && begin + b < some; ++b) {
                const float8 two = sums[b].lo + sums[b].hi;
                *(float4_at*)y_of(group + begin + b) = biases + (two.lo + two.hi);
            }
        });
    });
};
// The way back: adj_y_of(r) four numbers, the last one 0; adj_x_of(r) room for PADDED inputs;
// adj_first [WIDTH] the sum over rows, added to. Gradients of weights are added to g.
auto backward = [&](int n, const float* transposed, float* g, auto x_of, auto h_of, auto adj_y_of,
                    auto adj_x_of, float* adj_first) {
    by_groups(n, [&](int group, int some) {
        const float *x[GROUP], *h[GROUP];
        float adj_room[GROUP][WIDTH], below_room[GROUP][WIDTH], unused[PADDED];
        float *adj[GROUP], *below[GROUP], *adj_x[GROUP];
        float4 adj_y[GROUP];
        for (int b = 0; b < GROUP; ++b) {
            const int r = group + min(b, some - 1);
            x[b] = x_of(r), h[b] = h_of(r) + (HIDDEN - 1) * WIDTH;
            adj[b] = adj_room[b], below[b] = below_room[b];
            adj_x[b] = b < some ? adj_x_of(r) : unused;
            adj_y[b] = b < some ? float4(*(const float4_at*)adj_y_of(r)) : float4(0.0f);
        }
        const auto behind_relu = [&](vec adj_h, int b, int u) -> vec {
            return at(h[b] + u) > 0.0f ? adj_h : splat(0.0f);
        };
        // The output.
        float* g_last = g + AT_OUTPUT;
        const float* t = transposed + PADDED * WIDTH + (HIDDEN - 1) * WIDTH * WIDTH;
        by_blocks(some, [&](auto rows, int begin, int) {
            constexpr int N = decltype(rows)::value;
            for (int b = begin; b < begin + N; ++b) {
                *(float4_at*)(g_last + OUTPUTS * WIDTH) += adj_y[b];
            }
            for (int i = 0; i < WIDTH; i += 4) {
                vec sum = at(g_last + OUTPUTS * i);
                #pragma clang loop unroll(full)
                for (int b = begin; b < begin + N; ++b) {
                    sum = fma(units_four_times(h[b] + i), outputs_four_times(adj_y[b]), sum);
                }
                put(g_last + OUTPUTS * i, sum);
            }
            for (int u = 0; u < WIDTH; u += LANES) {
                #pragma clang loop unroll(full)
                for (int b = begin; b < begin + N; ++b) {
                    vec sum = adj_y[b][0] * at(t + u);
                    sum = fma(splat(adj_y[b][1]), at(t + WIDTH + u), sum);
                    sum = fma(splat(adj_y[b][2]), at(t + 2 * WIDTH + u), sum);
                    put(adj[b] + u, behind_relu(sum, b, u));
                }
            }
        });
        // Hidden layers, the last one first. Nothing flows back through units that are 0.
        ActiveUnits active[HIDDEN][MAX_BLOCKS];
        find_active(some, h, active[HIDDEN - 1]);
        for (int layer = HIDDEN - 1; layer > 0; --layer) {
            float* to = g + AT_HIDDEN + (layer - 1) * LAYER;
            t -= WIDTH * WIDTH;
            for (int b = 0; b < GROUP; ++b) h[b] -= WIDTH;
            find_active(some, h, active[layer - 1]);
            const auto active_of = [&](int block) -> auto& { return active[layer][block]; };
            const auto active_below = [&](int block) -> auto& { return active[layer - 1][block]; };
            add_outer(some, to, to + WIDTH * WIDTH, active_below, h, adj);
            multiply(some, t, active_of, WIDTH, Several(), adj, zero, below, behind_relu);
            for (int b = 0; b < GROUP; ++b) {
                float* kept = adj[b];
                adj[b] = below[b], below[b] = kept;
            }
        }
        const auto active_of = [&](int block) -> auto& { return active[0][block]; };
        add_outer(some, g, adj_first, all_inputs, x, adj);
        multiply(some, transposed, active_of, PADDED, Inputs(), adj, zero, adj_x, as_is);
    });
};
"""
"""The vector form: a batch of rows through the layers and back."""

BEGIN_ROWS = r"""
const size_t n_transposed = weights.transposed.shape[1];
transpose(weights.values.data, weights.transposed.data + worker * n_transposed);
"""
