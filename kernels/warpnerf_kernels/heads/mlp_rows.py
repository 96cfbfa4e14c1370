"""The vector form of an MLP, in C++: rows through its layers and back, four at a time.

The units of a row lie side by side in vectors, so that a layer takes four rows through each vector
of weights that it loads. How weights lie, mlp.py says; the way back reads a copy of them in which
rows and columns are exchanged.
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
constexpr int ROWS_AT_ONCE = 4;
constexpr int PADDED = (INPUTS + LANES - 1) / LANES * LANES;  // inputs in whole vectors
constexpr int LAYER = WIDTH * WIDTH + WIDTH;
constexpr int VECS = WIDTH % (2 * LANES) ? 1 : 2;  // vectors of units worked on together
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
auto multiply = [&](const float* w, int n_inputs, int units, auto step, const float* const* x,
                    const float* const* first, float* const* out, auto act) {
    constexpr int AT_ONCE = decltype(step)::value;
    for (int u = 0; u < units; u += AT_ONCE * LANES) {
        vec sum[ROWS_AT_ONCE][AT_ONCE];
        #pragma clang loop unroll(full)
        for (int b = 0; b < ROWS_AT_ONCE; ++b) {
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) {
                sum[b][v] = first ? at(first[b] + u + v * LANES) : all(0.0f);
            }
        }
        for (int i = 0; i < n_inputs; ++i) {
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) {
                const vec row = at(w + i * units + u + v * LANES);
                #pragma clang loop unroll(full)
                for (int b = 0; b < ROWS_AT_ONCE; ++b) {
                    sum[b][v] = fma(all(x[b][i]), row, sum[b][v]);
                }
            }
        }
        #pragma clang loop unroll(full)
        for (int b = 0; b < ROWS_AT_ONCE; ++b) {
            #pragma clang loop unroll(full)
            for (int v = 0; v < AT_ONCE; ++v) {
                put(out[b] + u + v * LANES, act(sum[b][v], b, u + v * LANES));
            }
        }
    }
};
// w[i][:] += sum_b x[b][i] adj[b][:], and biases[:] += sum_b adj[b][:].
auto add_outer = [&](float* w, float* biases, int n_inputs, const float* const* x,
                     const float* const* adj) {
    for (int u = 0; u < WIDTH; u += VECS * LANES) {
        vec a[ROWS_AT_ONCE][VECS];
        #pragma clang loop unroll(full)
        for (int v = 0; v < VECS; ++v) {
            vec sum = all(0.0f);
            #pragma clang loop unroll(full)
            for (int b = 0; b < ROWS_AT_ONCE; ++b) sum += a[b][v] = at(adj[b] + u + v * LANES);
            if (biases) put(biases + u + v * LANES, at(biases + u + v * LANES) + sum);
        }
        for (int i = 0; i < n_inputs; ++i) {
            #pragma clang loop unroll(full)
            for (int v = 0; v < VECS; ++v) {
                float* to = w + i * WIDTH + u + v * LANES;
                vec sum = at(to);
                #pragma clang loop unroll(full)
                for (int b = 0; b < ROWS_AT_ONCE; ++b) sum = fma(all(x[b][i]), a[b][v], sum);
                put(to, sum);
            }
        }
    }
};
struct One { enum { value = 1 }; };
struct Several { enum { value = VECS }; };
struct Inputs { enum { value = PADDED % (2 * LANES) ? 1 : 2 }; };
auto as_is = [&](vec x, int, int) -> vec { return x; };
auto relu = [&](vec x, int, int) -> vec { return x < 0.0f ? all(0.0f) : x; };  // keeps a NaN
// Rows 0 to n - 1: x_of(r) their inputs, first_of(r) what the first layer begins with, h_of(r) room
// for all hidden units, y_of(r) room for four outputs.
auto forward = [&](int n, const float* w, auto x_of, auto first_of, auto h_of, auto y_of) {
    for (int begin = 0; begin < n; begin += ROWS_AT_ONCE) {
        const float *x[ROWS_AT_ONCE], *first[ROWS_AT_ONCE];
        float* h[ROWS_AT_ONCE];
        float unused[HIDDEN * WIDTH];
        for (int b = 0; b < ROWS_AT_ONCE; ++b) {
            const int r = least(begin + b, n - 1);
            x[b] = x_of(r), first[b] = first_of(r);
            h[b] = begin + b < n ? h_of(r) : unused;
        }
        multiply(w, INPUTS, WIDTH, Several(), x, first, h, relu);
        for (int layer = 1; layer < HIDDEN; ++layer) {
            const float* from = w + AT_HIDDEN + (layer - 1) * LAYER;
            const float *below[ROWS_AT_ONCE], *biases[ROWS_AT_ONCE];
            for (int b = 0; b < ROWS_AT_ONCE; ++b) {
                below[b] = h[b], biases[b] = from + WIDTH * WIDTH, h[b] += WIDTH;
            }
            multiply(from, WIDTH, WIDTH, Several(), below, biases, h, relu);
        }
        vec sums[ROWS_AT_ONCE];
        const float* last = w + AT_OUTPUT;
        for (int b = 0; b < ROWS_AT_ONCE; ++b) sums[b] = all(0.0f);
        for (int i = 0; i < WIDTH; i += 4) {
            const vec four = at(last + OUTPUTS * i);
            #pragma clang loop unroll(full)
            for (int b = 0; b < ROWS_AT_ONCE; ++b) {
                sums[b] = fma(units_four_times(h[b] + i), four, sums[b]);
            }
        }
        const quad biases = *(const quad_at*)(last + OUTPUTS * WIDTH);
        for (int b = 0; b < ROWS_AT_ONCE && begin + b < n; ++b) {
            const octet two = sums[b].lo + sums[b].hi;
            *(quad_at*)y_of(begin + b) = biases + (two.lo + two.hi);
        }
    }
};
// The way back: adj_y_of(r) four numbers, the last one 0; adj_x_of(r) room for PADDED inputs;
// adj_first [WIDTH] the sum over rows, added to. Gradients of weights are added to g.
auto backward = [&](int n, const float* transposed, float* g, auto x_of, auto h_of, auto adj_y_of,
                    auto adj_x_of, float* adj_first) {
    for (int begin = 0; begin < n; begin += ROWS_AT_ONCE) {
        const float *x[ROWS_AT_ONCE], *h[ROWS_AT_ONCE];
        float adj_room[ROWS_AT_ONCE][WIDTH], below_room[ROWS_AT_ONCE][WIDTH];
        float input_room[ROWS_AT_ONCE][PADDED];
        float *adj[ROWS_AT_ONCE], *below[ROWS_AT_ONCE], *adj_x[ROWS_AT_ONCE];
        quad adj_y[ROWS_AT_ONCE];
        for (int b = 0; b < ROWS_AT_ONCE; ++b) {
            const int r = least(begin + b, n - 1);
            x[b] = x_of(r), h[b] = h_of(r) + (HIDDEN - 1) * WIDTH;
            adj[b] = adj_room[b], below[b] = below_room[b];
            adj_x[b] = begin + b < n ? adj_x_of(r) : input_room[b];
            adj_y[b] = begin + b < n ? quad(*(const quad_at*)adj_y_of(r)) : quad(0.0f);
        }
        // The output.
        float* g_last = g + AT_OUTPUT;
        const float* t = transposed + PADDED * WIDTH + (HIDDEN - 1) * WIDTH * WIDTH;
        *(quad_at*)(g_last + OUTPUTS * WIDTH) += (adj_y[0] + adj_y[1]) + (adj_y[2] + adj_y[3]);
        for (int i = 0; i < WIDTH; i += 4) {
            vec sum = at(g_last + OUTPUTS * i);
            #pragma clang loop unroll(full)
            for (int b = 0; b < ROWS_AT_ONCE; ++b) {
                sum = fma(units_four_times(h[b] + i), outputs_four_times(adj_y[b]), sum);
            }
            put(g_last + OUTPUTS * i, sum);
        }
        auto behind_relu = [&](vec adj_h, int b, int u) -> vec {
            return at(h[b] + u) > 0.0f ? adj_h : all(0.0f);
        };
        for (int u = 0; u < WIDTH; u += LANES) {
            #pragma clang loop unroll(full)
            for (int b = 0; b < ROWS_AT_ONCE; ++b) {
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
            for (int b = 0; b < ROWS_AT_ONCE; ++b) h[b] -= WIDTH;
            add_outer(to, to + WIDTH * WIDTH, WIDTH, h, adj);
            multiply(t, WIDTH, WIDTH, Several(), adj, nullptr, below, behind_relu);
            for (int b = 0; b < ROWS_AT_ONCE; ++b) {
                float* kept = adj[b];
                adj[b] = below[b], below[b] = kept;
            }
        }
        add_outer(g, adj_first, INPUTS, x, adj);
        multiply(transposed, WIDTH, PADDED, Inputs(), adj, nullptr, adj_x, as_is);
    }
};
"""
"""The vector form: a batch of rows through the layers and back."""

BEGIN_ROWS = r"""
const size_t n_transposed = weights.transposed.shape[1];
transpose(weights.values.data, weights.transposed.data + worker * n_transposed);
"""
