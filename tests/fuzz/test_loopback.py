"""What listens, listens to this machine only."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tau_dyn.robot import load_robot

pytestmark = pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="sockets are listed there on Linux only")


def addresses(processes: list[int]) -> set[str]:
    """Return the addresses that processes listen at, in the kernel's own writing; `0100007F` is 127.0.0.1."""
    sockets = set()
    for process in processes:
        for handle in Path(f"/proc/{process}/fd").iterdir():
            try:
                sockets.add(os.readlink(handle))
            except OSError:  # closed meanwhile
                continue
    rows = [row.split() for table in ("tcp", "tcp6") for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    return {row[1].partition(":")[0] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets}


def test_the_viewer_listens_on_loopback() -> None:
    """By default nobody else in the network sees the robot or moves its sliders."""
    pytest.importorskip("viser")
    from tau_dyn.view import Viewer

    before = addresses([os.getpid()])
    viewer = Viewer(load_robot("linear_axis"))
    try:
        assert viewer.url.startswith("http://127.0.0.1:")
        assert addresses([os.getpid()]) - before <= {"0100007F"} and "0100007F" in addresses([os.getpid()])
    finally:
        viewer.close()


def test_the_embedded_cluster_listens_on_loopback_its_dashboard_too() -> None:
    """Dask asks nobody who he is: whoever reaches a scheduler runs code."""
    distributed = pytest.importorskip("distributed")
    from tau_dyn.scale.runner import connect_client

    with connect_client(None, 1) as client:
        workers = [worker["nanny"] for worker in client.scheduler_info()["workers"].values()]
        mine = [os.getpid(), *client.run(os.getpid).values()]
        found = addresses(mine)
        assert workers and distributed and found == {"0100007F"}
