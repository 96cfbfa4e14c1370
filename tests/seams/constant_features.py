"""An encoding: density is trilinear in a dense grid, features are those of its first node."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warpnerf.config import OptimConfig
from warpnerf.model.interface import Load, Model


@cache
def encoding(load: Load) -> Any:
    dense, types = load("fields.dense"), load("base.types")
    real, vec3 = types.real, types.vec3
    read_dense, adj_read_dense = dense.read, dense.adj_read

    @wp.func
    def read(grid: Any, position: vec3):
        raw = read_dense(grid, position)
        out = grid.values[0]
        out[0] = raw[0]
        return out

    @wp.func
    def adj_read(grid: Any, position: vec3, adj_raw: Any, gradient: Any):
        of_density = adj_raw * real(0.0)
        of_density[0] = adj_raw[0]
        adj_read_dense(grid, position, of_density, gradient)
        of_features = adj_raw - of_density
        gradient.touched[0] = wp.uint8(1)
        wp.atomic_add(gradient.values, 0, of_features)

    return load("base.parts").Encoding(
        n_floats=4,
        Params=dense.grid_type(4),
        read=read,
        adj_read=adj_read,
        place=dense.place,
    )


@dataclass(frozen=True, kw_only=True)
class OneColour(Model):
    """Matter of one colour."""

    name: ClassVar[str] = "one-colour"

    @property
    def n_features(self) -> int:
        return 3

    def parts(self, load: Load) -> Any:
        return load("launch.assembly").Parts(encoding=encoding(load), head=load("heads.rgb").rgb())

    def variation(self, optim: OptimConfig) -> np.ndarray:
        return np.array([optim.tv_density, 0.0, 0.0, 0.0])
