"""A multilayer perceptron: hidden layers with ReLU, three outputs. Its weights lie in one array.

    h_1 = relu(first + W_1 x),   h_l = relu(b_l + W_l h_(l-1)),   y = b_out + W_out h_n

``first`` is b_1, or that and the share of inputs that are the same for many rows. Weights lie as
[inputs, width] a layer, each followed by its biases [width]; the output's as [width, 4] and [4],
of which the last column is padding.

The vector form works on rows: four at a time, whose units lie side by side in vectors. Gradients of
weights go to a worker's own copy, so that their sum does not depend on which worker is first.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from ..base.simd import LANES, VECTORS
from ..base.types import real, vec3, vector

wp.set_module_options({"enable_backward": False})

OUTPUTS = 4
"""Columns of the output's weights: red, green, blue, padding."""


@wp.struct
class Weights:
    """The weights as kernels take them."""

    values: wp.array(dtype=real)  # [n_weights]
    transposed: wp.array2d(dtype=real)  # [n_workers, n_transposed] scratch of the vector form


class Layout(NamedTuple):
    """The shape of an MLP, and where its weights lie."""

    n_own: int
    """Inputs of each row."""
    n_shared: int
    """Inputs that many rows share, whose part of the first layer is worked out once: the view's."""
    width: int
    """Units of a hidden layer, a multiple of 16."""
    n_hidden: int
    """Hidden layers."""

    @property
    def n_inputs(self) -> int:
        """How many inputs there are; a row's own come first."""
        return self.n_own + self.n_shared

    @property
    def units(self) -> int:
        """How many units all hidden layers have together."""
        return self.width * self.n_hidden

    @property
    def layer_size(self) -> int:
        """Weights and biases of a hidden layer after the first."""
        return self.width * self.width + self.width

    @property
    def at_biases(self) -> int:
        """Where the first layer's biases lie."""
        return self.n_inputs * self.width

    @property
    def at_hidden(self) -> int:
        """Where the second layer lies."""
        return self.at_biases + self.width

    @property
    def at_output(self) -> int:
        """Where the output's weights lie."""
        return self.at_hidden + (self.n_hidden - 1) * self.layer_size

    @property
    def n_weights(self) -> int:
        """How many weights and biases there are, padding included."""
        return self.at_output + OUTPUTS * (self.width + 1)

    @property
    def n_transposed(self) -> int:
        """Numbers of the transposed copy: W_1 of own inputs, the other layers, the output."""
        hidden = (self.n_hidden - 1) * self.width * self.width
        return self.n_padded * self.width + hidden + 3 * self.width

    @property
    def n_padded(self) -> int:
        """A row's own inputs, in whole vectors."""
        return -(-self.n_own // LANES) * LANES


@wp.func
def relu(x: real) -> real:
    """max(x, 0), but what is not a number stays so: else a broken training would not show."""
    return wp.where(x < real(0.0), real(0.0), x)


class Mlp(NamedTuple):
    """The scalar forms for one layout, each with its adjoint behind it, and the vector form."""

    first: Any
    """(weights) -> [width] the first layer's biases."""
    adj_first: Any
    """(adj_first, gradient) transpose of first."""
    add_inputs: Any
    """(weights, begin, x, first) -> first + W_1[begin:] x, for any number of inputs."""
    adj_add_inputs: Any
    """(weights, begin, x, adj_first, gradient) -> adj_x."""
    outputs: Any
    """(weights, first) -> y."""
    adj_outputs: Any
    """(weights, first, adj_y, gradient) -> adj_first."""
    begin_rows: Any
    """(weights, worker) makes a worker's transposed copy."""
    words: str
    """C++ of the vector form: transpose(), forward() and backward() on rows."""


@cache
def mlp(layout: Layout) -> Mlp:
    """The functions of an MLP.

    Args:
        layout: Its shape; width is a multiple of 16.
    """
    width, n_hidden, units = layout.width, layout.n_hidden, layout.units
    biases, hidden, output = layout.at_biases, layout.at_hidden, layout.at_output
    layer_size = layout.layer_size
    Units = vector(width)
    Activations = vector(units)

    # Loops run to n_units, a variable: up to 16, constant bounds would have Warp write them out, as
    # thousands of lines that take a quarter of a minute to compile.

    @wp.func
    def first(weights: Weights) -> Units:
        n_units = int(width)
        out = Units()
        for j in range(n_units):
            out[j] = weights.values[biases + j]
        return out

    @wp.func
    def adj_first(adj: Units, gradient: Any):
        n_units = int(width)
        for j in range(n_units):
            wp.atomic_add(gradient.weights, 0, biases + j, adj[j])

    @wp.func
    def add_inputs(weights: Weights, begin: int, x: Any, out: Units) -> Units:
        n_units = int(width)
        for i in range(len(x)):
            for j in range(n_units):
                out[j] += x[i] * weights.values[(begin + i) * width + j]
        return out

    @wp.func
    def adj_add_inputs(weights: Weights, begin: int, x: Any, adj: Units, gradient: Any):
        n_units = int(width)
        adj_x = x * real(0.0)
        for i in range(len(x)):
            for j in range(n_units):
                n = (begin + i) * width + j
                adj_x[i] += adj[j] * weights.values[n]
                wp.atomic_add(gradient.weights, 0, n, x[i] * adj[j])
        return adj_x

    @wp.func
    def activations(weights: Weights, before: Units) -> Activations:
        """All hidden layers' units, ReLU applied."""
        n_units = int(width)
        h = Activations()
        for j in range(n_units):
            h[j] = relu(before[j])
        for layer in range(1, n_hidden):
            at = hidden + (layer - 1) * layer_size
            for j in range(n_units):
                total = weights.values[at + width * width + j]
                for i in range(n_units):
                    total += h[(layer - 1) * width + i] * weights.values[at + i * width + j]
                h[layer * width + j] = relu(total)
        return h

    @wp.func
    def outputs(weights: Weights, before: Units) -> vec3:
        n_units = int(width)
        h = activations(weights, before)
        at = output + 4 * width
        y = vec3(weights.values[at], weights.values[at + 1], weights.values[at + 2])
        for i in range(n_units):
            for o in range(3):
                y[o] += h[(n_hidden - 1) * width + i] * weights.values[output + 4 * i + o]
        return y

    @wp.func
    def adj_outputs(weights: Weights, before: Units, adj_y: vec3, gradient: Any) -> Units:
        n_units = int(width)
        h = activations(weights, before)
        adj = Units()
        for o in range(3):
            wp.atomic_add(gradient.weights, 0, output + 4 * width + o, adj_y[o])
        for i in range(n_units):
            unit = h[(n_hidden - 1) * width + i]
            total = real(0.0)
            for o in range(3):
                total += adj_y[o] * weights.values[output + 4 * i + o]
                wp.atomic_add(gradient.weights, 0, output + 4 * i + o, unit * adj_y[o])
            adj[i] = wp.where(unit > real(0.0), total, real(0.0))
        for back in range(1, n_hidden):
            layer = n_hidden - back
            at = hidden + (layer - 1) * layer_size
            below = Units()
            for j in range(n_units):
                wp.atomic_add(gradient.weights, 0, at + width * width + j, adj[j])
            for i in range(n_units):
                unit = h[(layer - 1) * width + i]
                total = real(0.0)
                for j in range(n_units):
                    total += adj[j] * weights.values[at + i * width + j]
                    wp.atomic_add(gradient.weights, 0, at + i * width + j, unit * adj[j])
                below[i] = wp.where(unit > real(0.0), total, real(0.0))
            adj = below
        return adj

    words = _words(layout)

    @wp.func_native(words + BEGIN_ROWS)
    def begin_rows(weights: Weights, worker: int): ...

    return Mlp(
        first=first,
        adj_first=adj_first,
        add_inputs=add_inputs,
        adj_add_inputs=adj_add_inputs,
        outputs=outputs,
        adj_outputs=adj_outputs,
        begin_rows=begin_rows,
        words=words,
    )


def _words(layout: Layout) -> str:
    constants = {
        "INPUTS": layout.n_own,
        "WIDTH": layout.width,
        "HIDDEN": layout.n_hidden,
        "AT_BIASES": layout.at_biases,
        "AT_HIDDEN": layout.at_hidden,
        "AT_OUTPUT": layout.at_output,
        "OUTPUTS": OUTPUTS,
    }
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
