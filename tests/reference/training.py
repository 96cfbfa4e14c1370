"""What training adds to rendering: the photometric loss, total variation, and one Adam step."""

import torch
from torch import Tensor


def photometric_loss(rgb: Tensor, target: Tensor) -> Tensor:
    """Mean over rays of the sum over channels of the squared error (three times the usual MSE).

    L = 1 / n_rays sum_rays sum_channels (rgb - target)^2,  dL/drgb = 2 (rgb - target) / n_rays

    Args:
        rgb: Rendered colours [n_rays, 3].
        target: Colours of the photographs [n_rays, 3].

    Returns:
        Loss [].
    """
    return ((rgb - target) ** 2).sum(dim=-1).mean()


def total_variation(raw: Tensor, weights: Tensor) -> Tensor:
    """Huber loss of the differences of neighbouring nodes, weighted by channel.

    TV = sum_c weight_c sum_axes sum_pairs huber(raw_a - raw_b)
    huber(d) = d^2 / 2 for |d| <= 1, |d| - 1/2 beyond

    Args:
        raw: Node values [X, Y, Z, C].
        weights: Weight per channel [C].

    Returns:
        Total variation [].
    """
    total = torch.zeros((), dtype=raw.dtype, device=raw.device)
    for axis in range(3):
        difference = raw.diff(dim=axis)
        size = difference.abs()
        huber = torch.where(size <= 1.0, difference**2 / 2.0, size - 0.5)
        total = total + (weights * huber).sum()
    return total


def adam(
    param: Tensor,
    m: Tensor,
    v: Tensor,
    grad: Tensor,
    step: int,
    lr: float | Tensor,
    beta1: float,
    beta2: float,
    eps: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """One Adam step; entries whose gradient is exactly zero keep their param, m and v.

    m' = beta1 m + (1 - beta1) g,  v' = beta2 v + (1 - beta2) g^2
    param' = param - lr m' / (1 - beta1^step) / (sqrt(v' / (1 - beta2^step)) + eps)
    Source: Kingma & Ba 2015, algorithm 1 (as torch.optim.Adam: eps is added after the bias
    correction). The bias is corrected by the global step, also where earlier steps were skipped.

    Args:
        param: Parameters [...].
        m: First moment [...].
        v: Second moment [...].
        grad: Gradient [...].
        step: Global step, 1 for the first.
        lr: Learning rate, one for all or per entry [...].
        beta1: Decay of the first moment.
        beta2: Decay of the second moment.
        eps: Added to the denominator.

    Returns:
        New (param, m, v); the arguments stay as they were.
    """
    if step < 1:
        raise ValueError(f"step counts from 1, got {step}.")
    new_m = beta1 * m + (1.0 - beta1) * grad
    new_v = beta2 * v + (1.0 - beta2) * grad**2
    corrected_m = new_m / (1.0 - beta1**step)
    corrected_v = new_v / (1.0 - beta2**step)
    new_param = param - lr * corrected_m / (corrected_v.sqrt() + eps)
    moves = grad != 0.0
    return (
        torch.where(moves, new_param, param),
        torch.where(moves, new_m, m),
        torch.where(moves, new_v, v),
    )
