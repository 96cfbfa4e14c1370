"""The public API with one argument of a wrong type or value."""

from __future__ import annotations

import inspect
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import warpnerf as wn
from tests.exporting.test_cameras import ball_scene
from tests.hostile.running import Case, fresh
from tests.hostile.values import PYTHON
from tests.rendering.test_composite import composite_of
from tests.support.solid_fields import ball_field
from tests.support.tiny_fields import tiny_field, tiny_state
from tests.support.tiny_scenes import ring, tiny_scene

Made = dict[str, Any]
Maker = Callable[[], tuple[Callable[..., object], Made]]
SHORT = replace(wn.TrainConfig(), steps=2, threads=1, model=wn.Rgb())


def targets(base: Path) -> dict[str, Maker]:
    """Calls of the public API that succeed, with the arguments that are varied."""
    scene, field = tiny_scene(ring(4)), tiny_field()
    camera = scene.cameras[0]
    lens = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy", "c2w")}
    rays = {"origins": np.zeros((2, 3)), "directions": np.array([[0.0, 0, 1]] * 2)}
    of_scene = {n: getattr(scene, n) for n in scene.__dataclass_fields__ if n != "warnings"}
    view = scene.views[0]
    together = composite_of([field] * 4)
    path = str(base / "scene")
    calls: dict[str, Maker] = {
        "load_scene": lambda: (wn.load_scene, {"path": path}),
        "inspect": lambda: (wn.inspect, {"path": path}),
        "train": lambda: (wn.train, {"scene": scene, "config": SHORT, "progress": False}),
        "evaluate": lambda: (wn.evaluate, {"field": field, "scene": scene}),
        "visibility": lambda: (wn.visibility, {"field": field, "views": scene.views[:2]}),
        "export": lambda: (wn.export, {"field": ball_field(), "path": "out.ply"}),
        "export folder": lambda: (
            wn.export,
            {"field": ball_field(), "path": "out", "scene": ball_scene()},
        ),
        "extract_surface": lambda: (wn.extract_surface, {"field": ball_field()}),
        "splats_of": lambda: (wn.splats_of, {"field": ball_field()}),
        "camera_path": lambda: (wn.camera_path, {"scene": scene, "n_frames": 3}),
        "render_video": lambda: (
            wn.render_video,
            {"field": field, "cameras": [camera], "path": "out.gif"},
        ),
        "render_stills": lambda: (
            wn.render_stills,
            {"field": field, "cameras": {"a": camera}, "folder": "out"},
        ),
        "read_path": lambda: (wn.read_path, {"path": str(base / "path.json")}),
        "path.cameras": lambda: (wn.read_path(base / "path.json").cameras, {"n_frames": 3}),
        "save_field": lambda: (wn.save_field, {"path": "out", "field": field}),
        "load_field": lambda: (wn.load_field, {"path": str(base / "run" / "field.safetensors")}),
        "save_checkpoint": lambda: (wn.save_checkpoint, {"path": "out", "state": tiny_state(1)}),
        "load_checkpoint": lambda: (wn.load_checkpoint, {"path": str(base / "none")}),
        "plan_picture": lambda: (wn.plan_picture, {"inspection": wn.inspect(path)}),
        "pose": lambda: (wn.pose, {"source": str(base / "none"), "output": "out"}),
        "demo": lambda: (wn.demo, {"output": "out", "steps": 0, "downscale": 32}),
        "field.render": lambda: (field.render, {"camera": camera}),
        "field.render_rays": lambda: (field.render_rays, rays),
        "field.beyond": lambda: (lambda distance: field.beyond(distance).render(camera), {}),
        "field.up_to": lambda: (lambda distance: field.up_to(distance).render(camera), {}),
        "field.cropped": lambda: (field.cropped, {"low": (-1.0,) * 3, "high": (1.0,) * 3}),
        "composite.cropped": lambda: (together.cropped, {"low": (-1.0,) * 3, "high": (1.0,) * 3}),
        "CompositeField": lambda: (wn.CompositeField, vars(together)),
        "Camera": lambda: (wn.Camera, lens),
        "View": lambda: (wn.View, {"name": "a", "camera": camera, "image": view.image}),
        "Scene": lambda: (wn.Scene, of_scene),
    }
    for kind in (
        *(
            wn.GridConfig,
            wn.MarchConfig,
            wn.OptimConfig,
            wn.LossConfig,
            wn.TrainConfig,
            wn.PoseConfig,
        ),
        *(wn.Deferred, wn.PerSample, wn.SphericalHarmonics, wn.Hash, wn.Vm, wn.Resampled),
    ):
        calls[kind.__name__] = lambda kind=kind: (kind, {})
        # Three times as likely: what people write by hand.
        calls[f"{kind.__name__} "] = calls[f"{kind.__name__}  "] = calls[kind.__name__]
    return calls | torch_targets()


def torch_targets() -> dict[str, Maker]:
    """Those of ``warpnerf.torch``."""
    import torch

    from warpnerf import torch as wt

    colors, sigmas, t = torch.rand(2, 3, 3), torch.rand(2, 3), torch.rand(2, 3)
    box = ((-1, -1, -1), (1, 1, 1))
    rays = (torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]))
    scaled = {"colors": colors, "sigmas": sigmas, "distances": t, "content_distance": 1.0}
    rendered = {"raw": torch.zeros(4, 4, 4, 4), "origins": rays[0], "directions": rays[1]}
    return {
        "scale_gradient": lambda: (wt.scale_gradient, scaled),
        "render_rays": lambda: (wt.render_rays, {**rendered, "box": box, "step": 0.5}),
        "March": lambda: (
            lambda step, near, far: wt.render_rays(
                **rendered, box=box, step=wt.March(step, near, far)
            ),
            {"step": 0.5, "near": 0.0, "far": None},
        ),
        "Head": lambda: (
            lambda model, layers: wt.render_rays(
                **rendered, box=box, step=0.5, head=wt.Head(model, layers)
            ),
            {"model": "rgb", "layers": ()},
        ),
    }


LONG = {("train", "config"), ("demo", "steps"), ("pose", "overwrite")}
"""Arguments whose defaults take minutes."""


def case(rng: random.Random, folder: Path, base: Path, calls: dict[str, Maker]) -> Case:
    """A call with one argument that is wrong."""
    fresh(folder)
    name = rng.choice(sorted(calls))
    function, given = calls[name]()
    own = inspect.signature(function).parameters.values()
    names = [p.name for p in own if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    varied = rng.choice(names)
    make = rng.choice(PYTHON)
    value = make()
    if value is None and (name, varied) in LONG:
        value = 7

    def call() -> object:
        found = function(**{**given, varied: value})
        return list(found) if inspect.isgenerator(found) else found

    text = type(value).__name__
    if isinstance(value, bool | float | str | type(None)) and len(str(value)) < 40:
        text = repr(value)
    return Case(call=call, said=f"{name.strip()}({varied}={text})")
