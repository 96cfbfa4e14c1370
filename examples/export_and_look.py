"""Write a trained scene for other programs, and look at it.

    warpnerf train builtin:room --output runs/room --time-limit 60
    python examples/export_and_look.py runs/room/field.safetensors --scene builtin:room --output out

Writes a mesh, Gaussian splats and the vertices of the mesh as points, says how much of each there
is, and renders stills along an orbit. `--view` then serves a page in the browser (extra `viewer`).
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import warp as wp

import warpnerf as wn


def main(words: Sequence[str] | None = None) -> list[Path]:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Export a trained scene and look at it.")
    parser.add_argument("field", help="a file that train_on_a_folder.py or a run has written")
    parser.add_argument("--scene", default="builtin:room", help="what it was trained on")
    parser.add_argument("--downscale", type=int, default=1, help="of the photographs")
    parser.add_argument("--output", default="out", help="a folder")
    parser.add_argument("--stills", type=int, default=4)
    parser.add_argument("--view", action="store_true", help="serve a page until Ctrl-C")
    args = parser.parse_args(words)
    wp.config.log_level = wp.LOG_ERROR  # Warp would name each kernel that it loads

    field = wn.load_field(args.field)
    scene = wn.load_scene(args.scene, downscale=args.downscale)
    folder = Path(args.output)
    folder.mkdir(parents=True, exist_ok=True)
    written = [
        wn.export(field, folder / f"scene.{ending}", scene=scene)  # only what photographs show
        for ending in ("glb", "splat.ply", "points.ply")
    ]
    visible = wn.visibility(field, [scene.views[index] for index in scene.splits["train"]])
    mesh, splats = wn.extract_surface(field, visible), wn.splats_of(field, visible)
    print(f"{len(mesh.faces)} triangles, {len(splats.centres)} splats")

    cameras = wn.camera_path(scene, "orbit", n_frames=args.stills)
    names = {f"orbit_{number}.png": camera for number, camera in enumerate(cameras)}
    wn.render_stills(field, names, folder)
    written += [folder / name for name in names]
    print("\n".join(map(str, written)))
    if args.view:
        wn.view(field, scene=scene)
    return written


if __name__ == "__main__":
    main()
