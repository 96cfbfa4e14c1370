"""Small kernels around single device functions, in the precision of the kernels under test."""

from functools import cache
from types import SimpleNamespace

import warp as wp
from warpnerf_kernels.base import precision

from tests.support.kernel_runner import Kernels
from warpnerf.model.spaces import part_of


def of(kernels: Kernels) -> SimpleNamespace:
    """The kernels below, in the precision of these."""
    return _of(kernels.precision)


@cache
def _of(name: str) -> SimpleNamespace:
    types = precision.load(name, "base.types")
    interp = precision.load(name, "fields.interp")
    activation = precision.load(name, "base.activation")
    gradscale = precision.load(name, "volume.gradscale")
    real, vec3, vec4 = types.real, types.vec3, types.vector(4)
    Gradient = types.gradient_type(4)

    @wp.kernel(module="unique", enable_backward=False)
    def gather_points(
        first: int,
        values: wp.array(dtype=vec4),
        size: wp.vec3i,
        points: wp.array(dtype=vec3),
        out: wp.array(dtype=vec4),
    ):
        n = first + wp.tid()
        u = points[n]
        node = interp.lowest_node(u, size)
        base = interp.flat_index(node[0], node[1], node[2], size)
        fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
        out[n] = interp.gather(values, size, base, fraction)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_points(
        first: int,
        size: wp.vec3i,
        points: wp.array(dtype=vec3),
        adj: wp.array(dtype=vec4),
        gradient: Gradient,
    ):
        n = first + wp.tid()
        u = points[n]
        node = interp.lowest_node(u, size)
        base = interp.flat_index(node[0], node[1], node[2], size)
        fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
        interp.adj_gather(size, base, fraction, adj[n], gradient)

    @wp.kernel(module="unique", enable_backward=False)
    def activate(
        first: int,
        x: wp.array(dtype=real),
        adj: wp.array(dtype=real),
        out_softplus: wp.array(dtype=real),
        out_adj_softplus: wp.array(dtype=real),
        out_sigmoid: wp.array(dtype=real),
        out_adj_sigmoid: wp.array(dtype=real),
        out_opacity: wp.array(dtype=real),
    ):
        n = first + wp.tid()
        tau = activation.softplus(x[n])
        out_softplus[n] = tau
        out_adj_softplus[n] = activation.adj_softplus(activation.softplus_slope(x[n]), adj[n])
        # the components differ, so that none can stand for another
        y = activation.sigmoid(vec3(x[n], real(2.0) * x[n], -x[n]))
        adj_x = activation.adj_sigmoid(y, vec3(adj[n], real(0.0), real(0.0)))
        other = activation.adj_sigmoid(y, vec3(real(0.0), real(0.0), adj[n]))
        out_sigmoid[n] = real(0.5) * (y[0] + real(1.0) - y[2])
        out_adj_sigmoid[n] = real(0.5) * (adj_x[0] + adj_x[1] + adj_x[2] + other[2])
        out_opacity[n] = activation.alpha_of(tau, wp.exp(-tau))

    @wp.kernel(module="unique", enable_backward=False)
    def scale_distances(
        first: int,
        t: wp.array(dtype=real),
        content_distance: wp.array(dtype=real),
        det_jacobian: wp.array(dtype=real),
        scaling: int,
        jacobian: int,
        out: wp.array(dtype=real),
    ):
        n = first + wp.tid()
        out[n] = gradscale.distance_scale(
            t[n], content_distance[n], det_jacobian[n], scaling, jacobian
        )

    return SimpleNamespace(
        gather_points=gather_points,
        scatter_points=scatter_points,
        activate=activate,
        scale_distances=scale_distances,
    )


@cache
def contract_points_of(kernels: Kernels, contraction: str) -> wp.Kernel:
    """Where a kind of space has points, its determinants, and how far out that is; and the same
    beyond the shell: all by the box's border."""
    space, types = part_of(contraction, kernels.precision), kernels.types
    real, vec3, Box = types.real, types.vec3, types.Box
    contract, det_jacobian, boxes_out = space.contract, space.det_jacobian, space.boxes_out

    @wp.kernel(module="unique", enable_backward=False)
    def contract_points(
        first: int,
        q: wp.array(dtype=vec3),
        box: Box,  # of which only the border counts
        out_c: wp.array(dtype=vec3),
        out_det: wp.array(dtype=real),
        out_boxes: wp.array(dtype=real),
        out_beyond: wp.array(dtype=real),
    ):
        n = first + wp.tid()
        out_c[n] = contract(box, q[n])
        out_det[n] = det_jacobian(box, q[n])
        out_boxes[n] = boxes_out(box, out_c[n])
        out_beyond[n] = boxes_out(
            box, vec3(real(0.0), real(1.0) + real(1.5) * box.border, real(0.0))
        )

    return contract_points
