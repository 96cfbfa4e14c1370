"""A real Ray on this machine: two workers, one of which is killed while it trains."""

from __future__ import annotations

import os
import signal
import socket
from pathlib import Path

import pytest

from tests.blocks.test_train_blocks import OPTIONS, cut, until
from tests.support import cli_process
from tests.support.tiny_runs import run, start
from warpnerf.blocks.engines import largest_machine
from warpnerf.blocks.folder import BlockFolder


def test_an_address_where_no_ray_is() -> None:
    pytest.importorskip("ray")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and nobody listens
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        from warpnerf.blocks.engines import RayEngine
        from warpnerf.checks import InputError

        with pytest.raises(InputError, match=f"--address {address}: no Ray is there"):
            RayEngine(address, None, None)


def test_the_largest_machine_counts() -> None:
    """A job's cores are on one machine, which is still there."""
    sizes = [(True, {"CPU": 4.0}), (False, {"CPU": 64.0}), (True, {"memory": 1.0})]
    nodes = [{"Alive": alive, "Resources": resources} for alive, resources in sizes]
    assert largest_machine(nodes) == 4 and largest_machine(nodes[1:]) == 1


@pytest.mark.slow
def test_a_killed_worker_s_block_is_taken_over(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    blocks = BlockFolder.read(cut(tmp_path / "room"))
    ray = ("--engine", "ray", "--workers", "2", "--threads", "1")
    steps = ("--steps", "600", "--checkpoint-every", "0.3", *OPTIONS)
    first, second = blocks.run(0), blocks.run(1)
    process = start("train-blocks", blocks.folder, *ray, "--", *steps)
    until(lambda: first.last_step is not None and second.last_step is not None, process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=cli_process.LIMIT)
    assert process.returncode == 130, (out, err)
    assert "stopped and saved after step" in (blocks.folder / "block-0.log").read_text()
    saved = first.last_step or 0
    process = start("train-blocks", blocks.folder, *ray)
    until(lambda: (first.last_step or 0) > saved, process)
    training = int((first.folder / ".lock").read_text())
    worker = int(Path(f"/proc/{training}/stat").read_text().rpartition(")")[2].split()[1])
    os.kill(worker, signal.SIGKILL)
    out, err = process.communicate(timeout=cli_process.LIMIT)
    assert process.returncode == 0, (out, err)
    assert "block-0 was lost; it is taken over" in out and "block-0 resumes" in out
    said = (blocks.folder / "block-0.log").read_text()
    assert "resuming after step" in said
    assert "block-1 was lost" not in out and out.count("is done") == 2
    before = [path.stat().st_mtime_ns for path in blocks.folder.glob("*/field.safetensors")]
    code, out, err = run("train-blocks", blocks.folder)
    assert code == 0 and "begins" not in out, (out, err)
    after = [path.stat().st_mtime_ns for path in blocks.folder.glob("*/field.safetensors")]
    assert before == after and len(after) == 2


@pytest.mark.slow  # starts a Ray
def test_more_cores_than_any_machine_has(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    folder = cut(tmp_path / "room")
    code, _, err = run("train-blocks", folder, "--engine", "ray", "--threads", "9999")
    assert code == 2 and "no machine of the cluster has so many cores" in err
