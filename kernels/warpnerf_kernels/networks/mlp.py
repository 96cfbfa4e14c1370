"""A multilayer perceptron: hidden layers with ReLU, three outputs. Its weights lie in one array.

    h_1 = relu(first + W_1 x),   h_l = relu(b_l + W_l h_(l-1)),   y = b_out + W_out h_n

``first`` is b_1, or that and the share of inputs that are the same for many rows. Weights lie as
[inputs, width] a layer, each followed by its biases [width]; the output's as [width, 4] and [4],
of which the last column is padding.

The vector form works on rows, in C++: mlp_rows.py has it. Gradients of weights go to a worker's own
copy there, so that their sum does not depend on which worker is first.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from ..base.loops import runtime
from ..base.simd import LANES
from ..base.types import real, vec3, vector
from .mlp_rows import BEGIN_ROWS, prelude_of

wp.set_module_options({"enable_backward": False})

OUTPUTS = 4
"""Columns of the output's weights: red, green, blue, padding."""


@wp.struct
class Weights:
    """The weights as kernels take them."""

    values: wp.array(dtype=real)  # [n_weights]
    transposed: wp.array2d(dtype=real)  # [n_workers, n_transposed] scratch of the vector form
    width: int  # of hidden layers


ADD_WEIGHT = r"""
#ifdef __CUDA_ARCH__
// All rays add to the same few thousand weights, and additions to one number wait for each other.
// So a warp whose threads are all here, for the same weight, sums among themselves first.
const unsigned everyone = 0xffffffffu;
int same = 0;
#if __CUDA_ARCH__ >= 700  // older ones cannot tell
if (__activemask() == everyone) __match_all_sync(everyone, i, &same);
#endif
if (same) {
    for (int apart = 16; apart > 0; apart /= 2) value += __shfl_xor_sync(everyone, value, apart);
    if ((threadIdx.x & 31) == 0) atomicAdd(&to.data[i], value);
} else {
    atomicAdd(&to.data[i], value);
}
#else
wp::atomic_add(to, 0, i, value);
#endif
"""


class Layout(NamedTuple):
    """The shape of an MLP, and where its weights lie."""

    n_own: int
    """Inputs of each row."""
    n_shared: int
    """Inputs that many rows share, whose part of the first layer is computed once: the view's."""
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


@wp.func_native(ADD_WEIGHT)
def add_weight(to: wp.array2d(dtype=Any), i: int, value: Any):
    """to[0, i] += value."""


class Mlp(NamedTuple):
    """The scalar forms for one layout, each with its adjoint behind it, and the vector form."""

    first: Any
    """(weights) -> [width] the first layer's biases."""
    adj_first: Any
    """(weights, adj_first, gradient) transpose of first."""
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
    prelude: str
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

    # Loops run to a number that compilers do not know, else they write them out: Warp up to 16, and
    # CUDA's compiler whole layers, which takes it many times as long and is slower as well.

    @wp.func
    def first(weights: Weights) -> Units:
        n_units = weights.width
        out = Units()
        for j in range(n_units):
            out[j] = weights.values[biases + j]
        return out

    @wp.func
    def adj_first(weights: Weights, adj: Units, gradient: Any):
        n_units = weights.width
        for j in range(n_units):
            add_weight(gradient.weights, biases + j, adj[j])

    @wp.func
    def add_inputs(weights: Weights, begin: int, x: Any, out: Units) -> Units:
        n_units, n_inputs = weights.width, runtime(len(x))
        for i in range(n_inputs):
            for j in range(n_units):
                out[j] += x[i] * weights.values[(begin + i) * width + j]
        return out

    @wp.func
    def adj_add_inputs(weights: Weights, begin: int, x: Any, adj: Units, gradient: Any):
        n_units, n_inputs = weights.width, runtime(len(x))
        adj_x = x * real(0.0)
        for i in range(n_inputs):
            for j in range(n_units):
                n = (begin + i) * width + j
                adj_x[i] += adj[j] * weights.values[n]
                add_weight(gradient.weights, n, x[i] * adj[j])
        return adj_x

    @wp.func
    def activations(weights: Weights, before: Units) -> Activations:
        """All hidden layers' units, ReLU applied."""
        n_units = weights.width
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
        n_units = weights.width
        h = activations(weights, before)
        at = output + 4 * width
        y = vec3(weights.values[at], weights.values[at + 1], weights.values[at + 2])
        for i in range(n_units):
            for o in range(3):
                y[o] += h[(n_hidden - 1) * width + i] * weights.values[output + 4 * i + o]
        return y

    @wp.func
    def adj_outputs(weights: Weights, before: Units, adj_y: vec3, gradient: Any) -> Units:
        n_units = weights.width
        h = activations(weights, before)
        adj = Units()
        for o in range(3):
            add_weight(gradient.weights, output + 4 * width + o, adj_y[o])
        for i in range(n_units):
            unit = h[(n_hidden - 1) * width + i]
            total = real(0.0)
            for o in range(3):
                total += adj_y[o] * weights.values[output + 4 * i + o]
                add_weight(gradient.weights, output + 4 * i + o, unit * adj_y[o])
            adj[i] = wp.where(unit > real(0.0), total, real(0.0))
        for back in range(1, n_hidden):
            layer = n_hidden - back
            at = hidden + (layer - 1) * layer_size
            below = Units()
            for j in range(n_units):
                add_weight(gradient.weights, at + width * width + j, adj[j])
            for i in range(n_units):
                unit = h[(layer - 1) * width + i]
                total = real(0.0)
                for j in range(n_units):
                    total += adj[j] * weights.values[at + i * width + j]
                    add_weight(gradient.weights, at + i * width + j, unit * adj[j])
                below[i] = wp.where(unit > real(0.0), total, real(0.0))
            adj = below
        return adj

    prelude = prelude_of(
        INPUTS=layout.n_own,
        WIDTH=width,
        HIDDEN=n_hidden,
        AT_BIASES=biases,
        AT_HIDDEN=hidden,
        AT_OUTPUT=output,
        OUTPUTS=OUTPUTS,
    )

    @wp.func_native(prelude + BEGIN_ROWS)
    def begin_rows(weights: Weights, worker: int): ...

    return Mlp(
        first=first,
        adj_first=adj_first,
        add_inputs=add_inputs,
        adj_add_inputs=adj_add_inputs,
        outputs=outputs,
        adj_outputs=adj_outputs,
        begin_rows=begin_rows,
        prelude=prelude,
    )
