"""The vector form of an MLP, in C++: rows through its layers and back, a few at a time.

The units of a row lie side by side in vectors, so that a layer takes several rows through each
vector of weights that it loads. How weights lie, mlp.py says; the way back reads a copy of them in
which rows and columns are exchanged.
"""

from ..base.simd import VECTORS


def words_of(**constants: int) -> str:
    """C++ of the vector form: transpose(), forward() and backward() on rows.

    Args:
        constants: Of a layout: INPUTS (a row's own), WIDTH, HIDDEN (layers), AT_BIASES, AT_HIDDEN,
            AT_OUTPUT and OUTPUTS.
    """
    listed = ", ".join(f"{name} = {value}" for name, value in constants.items())
    return VECTORS + f"constexpr int {listed};\n" + ROWS


ROWS = r"""
typedef float quad_at __attribute__((ext_vector_type(4), aligned(4), may_alias));
constexpr int PADDED = (INPUTS + LANES - 1) / LANES * LANES;  // inputs in whole vectors
constexpr int LAYER = WIDTH * WIDTH + WIDTH;
// Rows, and vectors of units, that are worked on together: as many sums as registers hold. Sums are
// formed row by row, so that results do not depend on how many.
#ifdef __AVX512F__
constexpr int MOST_ROWS = 8, MOST_VECS = 2;
#else
constexpr int MOST_ROWS = 4, MOST_VECS = 1;
#endif
struct Few { enum { value = 4 }; };
struct Many { enum { value = MOST_ROWS }; };
struct Several { enum { value = WIDTH % (MOST_VECS * LANES) ? 1 : MOST_VECS }; };  // of a layer
struct Inputs { enum { value = PADDED % (MOST_VECS * LANES) ? 1 : MOST_VECS }; };
auto by_rows = [&](int n, auto visit) {
    for (int begin = 0; begin < n;) {
        if (n - begin > Few::value) visit(Many(), begin), begin += Many::value;
        else visit(Few(), begin), begin += Few::value;
    }
};
auto at = [&](const float* x) -> vec { return *(const vec_at*)x; };
auto put = [&](float* x, vec v) { *(vec_at*)x = v; };
// Of the output layer a vector holds the weights of four units. To go with it, units four times
// each, and outputs four times in a row.
auto units_four_times = [&](const float* h) -> vec {
    const quad q = *(const quad_at*)h;
    return __builtin_shufflevector(q, q, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
};
auto outputs_four_times = [&](quad q) -> vec {
    return __builtin_shufflevector(q, q, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3);
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
// out[b][:] = act(first[b][:] + sum_i x[b][i] w[i][:]) for some rows, `units` numbers each.
auto multiply = [&](auto rows, const float* w, int n_inputs, int units, auto step,
                    const float* const* x, const float* const* first, float* const* out, auto act) {
    constexpr int N = decltype(rows)::value, AT_ONCE = decltype(step)::value;
    for (int u = 0; u < units; u += AT_ONCE * LANES) {
        vec sum[N][AT_ONCE];
        #pragma clang loop unroll(full)
        for (int b = 0; b < N; ++b) {
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) {
                sum[b][v] = first ? at(first[b] + u + v * LANES) : all(0.0f);
            }
        }
        for (int i = 0; i < n_inputs; ++i) {
            vec row[AT_ONCE];
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) row[v] = at(w + i * units + u + v * LANES);
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) {
                    sum[b][v] = fma(all(x[b][i]), row[v], sum[b][v]);
                }
            }
        }
        #pragma clang loop unroll(full)
        for (int b = 0; b < N; ++b) {
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) {
                put(out[b] + u + v * LANES, act(sum[b][v], b, u + v * LANES));
            }
        }
    }
};
// w[i][:] += sum_b x[b][i] adj[b][:], and biases[:] += sum_b adj[b][:].
auto add_outer = [&](auto rows, float* w, float* biases, int n_inputs, const float* const* x,
                     const float* const* adj) {
    constexpr int N = decltype(rows)::value, AT_ONCE = Several::value;
    for (int u = 0; u < WIDTH; u += AT_ONCE * LANES) {
        vec a[N][AT_ONCE];
        #pragma clang loop unroll(full)
        for (int v = 0; v < AT_ONCE; ++v) {
            vec sum = at(biases + u + v * LANES);
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) sum += a[b][v] = at(adj[b] + u + v * LANES);
            put(biases + u + v * LANES, sum);
        }
        for (int i = 0; i < n_inputs; ++i) {
            float* to = w + i * WIDTH + u;
            vec sum[AT_ONCE];
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) sum[v] = at(to + v * LANES);
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                #pragma clang loop unroll(full)
                for (int v = 0; v < AT_ONCE; ++v) sum[v] = fma(all(x[b][i]), a[b][v], sum[v]);
            }
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) put(to + v * LANES, sum[v]);
        }
    }
};
auto as_is = [&](vec x, int, int) -> vec { return x; };
auto relu = [&](vec x, int, int) -> vec { return x < 0.0f ? all(0.0f) : x; };  // keeps a NaN
// Rows 0 to n - 1: x_of(r) their inputs, first_of(r) what the first layer begins with, h_of(r) room
// for all hidden units, y_of(r) room for four outputs.
auto forward = [&](int n, const float* w, auto x_of, auto first_of, auto h_of, auto y_of) {
    by_rows(n, [&](auto rows, int begin) {
        constexpr int N = decltype(rows)::value;
        const float *x[N], *first[N];
        float* h[N];
        float unused[HIDDEN * WIDTH];
        for (int b = 0; b < N; ++b) {
            const int r = least(begin + b, n - 1);
            x[b] = x_of(r), first[b] = first_of(r);
            h[b] = begin + b < n ? h_of(r) : unused;
        }
        multiply(rows, w, INPUTS, WIDTH, Several(), x, first, h, relu);
        for (int layer = 1; layer < HIDDEN; ++layer) {
            const float* from = w + AT_HIDDEN + (layer - 1) * LAYER;
            const float *below[N], *biases[N];
            for (int b = 0; b < N; ++b) {
                below[b] = h[b], biases[b] = from + WIDTH * WIDTH, h[b] += WIDTH;
            }
            multiply(rows, from, WIDTH, WIDTH, Several(), below, biases, h, relu);
        }
        vec sums[N];
        const float* last = w + AT_OUTPUT;
        for (int b = 0; b < N; ++b) sums[b] = all(0.0f);
        for (int i = 0; i < WIDTH; i += 4) {
            const vec four = at(last + OUTPUTS * i);
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                sums[b] = fma(units_four_times(h[b] + i), four, sums[b]);
            }
        }
        const quad biases = *(const quad_at*)(last + OUTPUTS * WIDTH);
        for (int b = 0; b < N && begin + b < n; ++b) {
            const octet two = sums[b].lo + sums[b].hi;
            *(quad_at*)y_of(begin + b) = biases + (two.lo + two.hi);
        }
    });
};
// The way back: adj_y_of(r) four numbers, the last one 0; adj_x_of(r) room for PADDED inputs;
// adj_first [WIDTH] the sum over rows, added to. Gradients of weights are added to g.
auto backward = [&](int n, const float* transposed, float* g, auto x_of, auto h_of, auto adj_y_of,
                    auto adj_x_of, float* adj_first) {
    by_rows(n, [&](auto rows, int begin) {
        constexpr int N = decltype(rows)::value;
        const float *x[N], *h[N];
        float adj_room[N][WIDTH], below_room[N][WIDTH], input_room[N][PADDED];
        float *adj[N], *below[N], *adj_x[N];
        quad adj_y[N];
        for (int b = 0; b < N; ++b) {
            const int r = least(begin + b, n - 1);
            x[b] = x_of(r), h[b] = h_of(r) + (HIDDEN - 1) * WIDTH;
            adj[b] = adj_room[b], below[b] = below_room[b];
            adj_x[b] = begin + b < n ? adj_x_of(r) : input_room[b];
            adj_y[b] = begin + b < n ? quad(*(const quad_at*)adj_y_of(r)) : quad(0.0f);
        }
        // The output.
        float* g_last = g + AT_OUTPUT;
        const float* t = transposed + PADDED * WIDTH + (HIDDEN - 1) * WIDTH * WIDTH;
        for (int b = 0; b < N; ++b) *(quad_at*)(g_last + OUTPUTS * WIDTH) += adj_y[b];
        for (int i = 0; i < WIDTH; i += 4) {
            vec sum = at(g_last + OUTPUTS * i);
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                sum = fma(units_four_times(h[b] + i), outputs_four_times(adj_y[b]), sum);
            }
            put(g_last + OUTPUTS * i, sum);
        }
        auto behind_relu = [&](vec adj_h, int b, int u) -> vec {
            return at(h[b] + u) > 0.0f ? adj_h : all(0.0f);
        };
        for (int u = 0; u < WIDTH; u += LANES) {
            #pragma clang loop unroll(full)
            for (int b = 0; b < N; ++b) {
                vec sum = adj_y[b][0] * at(t + u);
                sum = fma(all(adj_y[b][1]), at(t + WIDTH + u), sum);
                sum = fma(all(adj_y[b][2]), at(t + 2 * WIDTH + u), sum);
                put(adj[b] + u, behind_relu(sum, b, u));
            }
        }
        // Hidden layers, the last one first.
        for (int layer = HIDDEN - 1; layer > 0; --layer) {
            float* to = g + AT_HIDDEN + (layer - 1) * LAYER;
            t -= WIDTH * WIDTH;
            for (int b = 0; b < N; ++b) h[b] -= WIDTH;
            add_outer(rows, to, to + WIDTH * WIDTH, WIDTH, h, adj);
            multiply(rows, t, WIDTH, WIDTH, Several(), adj, nullptr, below, behind_relu);
            for (int b = 0; b < N; ++b) {
                float* kept = adj[b];
                adj[b] = below[b], below[b] = kept;
            }
        }
        add_outer(rows, g, adj_first, INPUTS, x, adj);
        multiply(rows, transposed, WIDTH, PADDED, Inputs(), adj, nullptr, adj_x, as_is);
    });
};
"""
"""The vector form: a batch of rows through the layers and back."""

BEGIN_ROWS = r"""
const size_t n_transposed = weights.transposed.shape[1];
transpose(weights.values.data, weights.transposed.data + worker * n_transposed);
"""
