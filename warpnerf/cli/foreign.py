"""Options of other programs that train radiance fields, and what stands for them here."""

from __future__ import annotations

from collections.abc import Collection

SCENE = "SCENE"
"""The word without an option: what to train on."""

_MEANT = {
    "--steps": (
        *("--iters", "--iterations", "--max-iterations", "--max-num-iterations", "--max-steps"),
        *("--n-iters", "--n-steps", "--niter", "--num-iterations", "--num-steps", "--N-iters"),
    ),
    SCENE: (
        *("--data", "--data-dir", "--datadir", "--data-path", "--dataset", "--scene", "--source"),
        *("--source-path", "--input", "--path"),
    ),
    "--scene": ("--data", "--data-dir", "--datadir", "--dataset", "--source-path", "--input"),
    "--output": (
        *("--output-dir", "--out", "--out-dir", "--save-dir", "--basedir", "--logdir"),
        *("--model-path", "--result-dir", "--workspace", "--expname", "--experiment-name"),
    ),
    "--downscale": ("--data-factor", "--downscale-factor", "--factor", "--resolution"),
    "--rays-per-step": (
        *("--batch-size", "--num-rays", "--n-rays", "--ray-batch-size", "--N-rand"),
        "--train-num-rays-per-batch",
    ),
    "--resume": ("--ckpt", "--checkpoint", "--load-checkpoint", "--load-dir", "--start-checkpoint"),
    "--device": ("--cuda", "--gpu", "--gpus"),
    "--background": ("--background-color",),
    "--box": ("--aabb",),
    "--near": ("--near-plane", "--min-near"),
    "--optim.learning-rate-density": ("--lr", "--learning-rate", "--lr-init", "--lrate"),
    "--split": (
        "--eval-mode",
        "--train-on",
        "--train-split-fraction",
        "--test-every",
        "--llffhold",
    ),
    "--voxels": ("--num-voxels", "--n-voxels"),
}


def meant_by(flag: str, flags: Collection[str]) -> str | None:
    """What stands for an option of another program.

    Args:
        flag: The option, as it was given.
        flags: The options that there are, and ``SCENE`` where the first word is one.

    Returns:
        One of these; None: it is of no program that is known here.
    """
    for ours, theirs in _MEANT.items():
        if flag in theirs and ours in flags:
            return ours
    return None
