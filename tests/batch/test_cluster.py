# SPDX-License-Identifier: BSD-3-Clause
"""Work on a cluster of two processes: in order, whatever is killed, bytes as of a serial run."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask.config
import numpy as np
import pytest
from distributed import Client, LocalCluster

import ltcl
from ltcl import images
from ltcl.batch import compensate_frames
from ltcl.batch.cluster import connect, stream
from ltcl.cli.main import main
from ltcl.errors import ClusterError, FileError, InputError, InputTypeError
from tests.problems import lambertian

from .conftest import WORKERS

pytestmark = pytest.mark.slow


def pids(client: Client, *workers: str) -> list[int]:
    """Processes of these workers, or of all."""
    answers: Any = client.run(os.getpid, workers=[*workers] or None, on_error="ignore")
    return [*answers.values()]


def kill(client: Client) -> None:
    """End a worker as the kernel does when memory is short."""
    os.kill(pids(client)[0], signal.SIGKILL)


def test_results_come_in_order_and_items_are_taken_as_results_are(client):
    taken = []

    def items() -> Iterator[int]:
        for number in range(40):
            taken.append(number)
            yield number

    def slow(number: int) -> int:
        time.sleep(0.05 if number % 5 == 0 else 0.0)
        return number * number

    for done, result in enumerate(stream(client, slow, items(), window=3)):
        assert result == done * done
        assert len(taken) <= done + 1 + 2 * 3
    assert len(taken) == 40
    for _ in range(50):  # nothing stays on the scheduler
        time.sleep(0.1 if client.futures else 0.0)
    assert not client.futures


def test_items_that_are_done_leave_memory(client):
    tracemalloc.start()
    try:
        sizes = []
        for length in stream(client, len, (bytes(1 << 19) for _ in range(40))):
            assert length == 1 << 19
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    # Here and on the scheduler, which is in this process.
    assert sizes[-1] - sizes[9] < 5 << 20, sizes


def test_a_function_is_sent_once_to_each_worker(client, monkeypatch):
    """And not to the scheduler at each look at the workers: it may hold a large T."""
    asked = []
    run = client.run

    def count(function: Any, *arguments: Any, workers: Any = None, **options: Any) -> Any:
        asked.append(len(workers))
        return run(function, *arguments, workers=workers, **options)

    monkeypatch.setattr("ltcl.batch.cluster.PERIOD", 0.02)
    monkeypatch.setattr(client, "run", count)
    list(stream(client, lambda number: time.sleep(0.05), range(12)))
    assert asked == [2, 2]  # before the first task, and at the end


def test_an_error_is_raised_at_the_place_of_its_item(client):
    def fails(number: int) -> int:
        if number == 7:
            raise InputError("number is 7")
        return number

    results = stream(client, fails, range(20))
    assert [next(results) for _ in range(7)] == [*range(7)]
    with pytest.raises(InputError, match="number is 7"):
        next(results)


@pytest.mark.rare
def test_what_was_killed_is_done_by_others_and_joins_again(client):
    def slow(number: int) -> tuple[int, int]:
        time.sleep(0.05)
        return number, os.getpid()

    results = []
    for result in stream(client, slow, range(100)):
        results.append(result)
        if len(results) in (5, 10, 15):
            kill(client)
    assert [number for number, _ in results] == [*range(100)]
    assert len({pid for _, pid in results}) >= 3  # of two


@pytest.mark.parametrize(
    ("select", "text"), [("abacus", "device is 'abacus'"), ("", "no OpenCL device")]
)
def test_a_worker_without_device_is_named_and_takes_no_work(client, caplog, select, text):
    first, second = client.nthreads()

    def hide() -> None:
        import pyopencl

        if select:
            os.environ["LTCL_DEVICE"] = select
        else:
            module: Any = pyopencl
            module.platforms = module.get_platforms
            module.get_platforms = list

    def show() -> None:
        import pyopencl

        os.environ.pop("LTCL_DEVICE", None)
        module: Any = pyopencl
        module.get_platforms = getattr(module, "platforms", module.get_platforms)

    client.run(hide, workers=[first])
    try:
        used = {*stream(client, lambda _: os.getpid(), range(20))}
    finally:
        client.run(show, workers=[first])
    assert used == {*pids(client, second)}
    lines = [record.getMessage() for record in caplog.records if first in record.getMessage()]
    assert len(lines) == 1
    assert text in lines[0]


def test_one_worker_for_each_gpu_unless_asked_for_more(client, caplog):
    def claim(gpu: bool) -> None:
        module: Any = importlib.import_module("ltcl.batch.cluster")
        module.original = getattr(module, "original", module.describe)
        module.describe = (lambda: ("A GPU", "host, bus 1")) if gpu else module.original

    def slow(_: int) -> int:
        time.sleep(0.05)
        return os.getpid()

    client.run(claim, True)
    try:
        used = {*stream(client, slow, range(20))}
        shared = {*stream(client, slow, range(20), share_gpu=True)}
    finally:
        client.run(claim, False)
    assert (len(used), len(shared)) == (1, 2)
    assert caplog.text.count("GPU of worker tcp://") == 1


def test_another_version_takes_no_work_and_without_workers_nothing_is_done(client, caplog):
    def rename(version: str) -> None:
        ltcl.__version__ = version

    client.run(rename, "0.0.9")
    try:
        with pytest.raises(ClusterError, match=r"tcp.* 2 "):
            list(stream(client, abs, range(3)))
    finally:
        client.run(rename, ltcl.__version__)
    assert f"has ltcl 0.0.9, and the client {ltcl.__version__}" in caplog.text
    assert list(stream(client, abs, range(3))) == [0, 1, 2]


def test_what_is_no_client_or_cannot_be_sent_is_refused(client):
    wrong: Any = 3
    with pytest.raises(InputTypeError, match="client is a int"):
        list(stream(wrong, abs, [1]))
    lock = threading.Lock()
    with pytest.raises(InputTypeError, match=r"sent.*lock"):
        list(stream(client, lambda _: lock, [1]))


GRID = (20, 30)  # 600 pixels, more than are factorized
FRAMES = 33
SCENE = lambertian(600, 0.6, seed=80)
random = np.random.default_rng(81)


@pytest.fixture(scope="module")
def film(tmp_path_factory, device) -> Path:
    """Frames, T, and the patterns that one process makes of both."""
    folder = tmp_path_factory.mktemp("film")
    ltcl.save(folder / "T.npz", ltcl.Transport(SCENE.T, GRID))
    for number in range(FRAMES):
        light = random.uniform(0.2, 0.6, SCENE.T.shape[1])
        images.write(folder / "in" / f"f{number}.exr", (SCENE.T @ light).reshape(GRID))
    T = ltcl.load(folder / "T.npz", device=device)
    compensate_frames(T, folder / "in", folder / "serial", batch=4, appearance=True)
    return folder


def everything(folder: Path) -> dict[str, bytes]:
    return {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


@pytest.mark.parametrize("seen", [True, False], ids=["file that workers see", "sent"])
def test_frames_have_the_bytes_of_a_serial_run(client, film, device, tmp_path, seen):
    T = ltcl.load(film / "T.npz", device=device)
    T = T if seen else ltcl.Transport(SCENE.T, GRID, device=device)
    calls = []
    common: dict[str, Any] = {"batch": 4, "appearance": True, "client": client, "resume": True}
    compensate_frames(T, film / "in", tmp_path, frames=8, **common)
    done = compensate_frames(
        T, film / "in", tmp_path, progress=lambda *now: calls.append(now), **common
    )
    assert everything(tmp_path) == everything(film / "serial")
    assert done.solved == FRAMES - 8
    assert [(step, total) for step, _, total in calls] == [("frames", FRAMES)] * len(calls)
    assert [count for _, count, _ in calls] == [8, 12, 16, 20, 24, 28, 32, 33]


@pytest.mark.rare
def test_killed_workers_leave_every_frame_once_and_whole(client, film, tmp_path):
    T = ltcl.load(film / "T.npz")
    counts = []

    def progress(step: str, done: int, total: int | None) -> None:
        counts.append(done)
        if len(counts) in (2, 4, 6):
            kill(client)

    done = compensate_frames(
        T, film / "in", tmp_path, batch=4, appearance=True, client=client, progress=progress
    )
    assert everything(tmp_path) == everything(film / "serial")
    assert (done.solved, counts) == (FRAMES, [*range(0, FRAMES, 4), FRAMES])


def test_another_T_in_the_file_of_a_worker_is_refused(client, film, tmp_path, caplog):
    path = tmp_path / "T.npz"
    shutil.copy(film / "T.npz", path)
    T = ltcl.load(path)
    ltcl.save(path, ltcl.Transport(2 * SCENE.T, GRID))
    with pytest.raises(ClusterError, match=r"no worker is left .*2 "):
        compensate_frames(T, film / "in", tmp_path / "out", client=client)
    assert caplog.text.count("another T") == 2
    assert not (tmp_path / "out").exists()


KILLS = """
import os, signal, sys
from ltcl.batch import manifest
from ltcl.cli.main import main

def write(folder, head, records, write=manifest.write):
    write(folder, head, records)
    if len(records) == 8:
        os.kill(int(sys.argv[1]), signal.SIGKILL)

manifest.write = write
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.rare
def test_a_killed_scheduler_is_one_line_and_the_next_run_goes_on(film, tmp_path):
    words = [
        "film",
        *map(str, (film / "T.npz", film / "in")),
        "--rtol",
        "0.01",
        "--appearance",
    ]
    words += ["--batch", "4", "--out", str(tmp_path / "out"), "--quiet"]
    file = str(tmp_path / "scheduler.json")
    dask = [sys.executable, "-m", "dask"]
    commands = ["scheduler --host 127.0.0.1 --port 0", "worker --nthreads 1 --no-nanny"]
    started = [
        [*dask, *each.split(), "--no-dashboard", "--scheduler-file", file] for each in commands
    ]
    processes = [subprocess.Popen(each, stderr=subprocess.DEVNULL) for each in started]
    try:
        with Client(scheduler_file=file) as client:
            client.wait_for_workers(1)
            address = client.scheduler_info()["address"]
        kills = [sys.executable, "-c", KILLS, str(processes[0].pid), *words, "--cluster", address]
        run = subprocess.run(kills, stderr=subprocess.PIPE, text=True, timeout=200)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert (run.returncode, run.stderr.count("\n")) == (1, 1), run.stderr
    # A batch of four that was solved before the end is written after it.
    assert re.search(r"was lost; (8|12) frame\(s\) are done", run.stderr), run.stderr
    assert main([*words, "--resume"]) == 0
    patterns = {
        name: data for name, data in everything(film / "serial").items() if "json" not in name
    }
    assert everything(tmp_path / "out").items() >= patterns.items()


@pytest.mark.parametrize("on_cluster", [False, True])
def test_broken_frames_are_left_out_and_named(request, film, device, tmp_path, on_cluster):
    client = request.getfixturevalue("client") if on_cluster else None
    folder = shutil.copytree(film / "in", tmp_path / "in")
    images.write(folder / "f2.exr", np.ones((3, 4)))
    (folder / "f7.exr").write_bytes(b"no picture")
    T = ltcl.load(film / "T.npz", device=device)
    common: dict[str, Any] = {"batch": 4, "frames": 12, "client": client, "appearance": True}
    with pytest.raises(FileError, match=r"(?s)3 \(.*3 x 4.*8 \(.*f7\.exr.*10 frame.*resume"):
        compensate_frames(T, folder, tmp_path / "out", **common)
    for number in (3, 8):
        shutil.copy(film / "in" / f"f{number - 1}.exr", folder)
        assert not (tmp_path / f"out/pattern_{number:06}.png").exists()
    assert compensate_frames(T, folder, tmp_path / "out", resume=True, **common).solved == 2
    same = compensate_frames(T, film / "in", tmp_path / "whole", **common)
    for record in same.records:
        name = f"pattern_{record.number:06}.png"
        np.testing.assert_allclose(
            images.read(tmp_path / "out" / name), images.read(tmp_path / "whole" / name), atol=0.02
        )


def test_a_lost_scheduler_is_one_line_and_the_next_run_goes_on(film, device, tmp_path):
    T = ltcl.load(film / "T.npz", device=device)
    here = {**WORKERS, "n_workers": 1, "processes": False, "protocol": "tcp://"}
    with LocalCluster(**here) as cluster, Client(cluster) as other:

        def progress(step: str, done: int, total: int | None) -> None:
            if done == 8:
                cluster.close()

        common: dict[str, Any] = {"batch": 4, "appearance": True}
        # The third batch, which was being written, is kept.
        with pytest.raises(ClusterError, match=r"scheduler .* 12 .*resume=True") as error:
            compensate_frames(T, film / "in", tmp_path, client=other, progress=progress, **common)
        assert "\n" not in str(error.value)
    compensate_frames(T, film / "in", tmp_path, resume=True, **common)
    assert everything(tmp_path) == everything(film / "serial")


@pytest.mark.rare
def test_the_command_line_does_frames_and_scenes_on_a_cluster(client, film, tmp_path, capsys):
    desired = tmp_path / "desired.png"
    images.write(desired, np.full(GRID, 0.2))
    for name in ("a", "b"):
        shutil.copy(film / "T.npz", tmp_path / f"{name}.npz")
    (tmp_path / "c.npz").write_bytes(b"no transport")
    address = client.scheduler.address
    out = tmp_path / "out"
    scenes = [
        "compensate",
        "--transports",
        str(tmp_path / "*.npz"),
        str(desired),
        "--out",
        str(out),
    ]
    assert main([*scenes, "--cluster", address]) == 1
    assert "1 of 3 scenes failed" in capsys.readouterr().err
    assert (
        main(["compensate", str(tmp_path / "a.npz"), str(desired), "--out", str(tmp_path / "one")])
        == 0
    )
    for name in ("a", "b"):
        for picture in tmp_path.glob("one/*.exr"):
            assert (out / name / picture.name).read_bytes() == picture.read_bytes()
    frames = ["film", str(film / "T.npz"), str(film / "in"), "--rtol", "0.01", "--batch", "4"]
    frames += ["--appearance", "--out", str(tmp_path / "frames")]
    assert main([*frames, "--cluster", "local", "--workers", "1", "--frames", "4"]) == 0
    assert main([*frames, "--cluster", address, "--resume"]) == 0
    patterns = {
        name: data for name, data in everything(film / "serial").items() if "json" not in name
    }
    assert everything(tmp_path / "frames").items() >= patterns.items()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--cluster", "127.0.0.1:9"], "no scheduler answers"),
        (["--cluster", "nonsense"], "cluster is 'nonsense'"),
        (["--cluster", ""], "cluster is ''"),
        (["--cluster", "127.0.0.1:99999"], "99999'; it must be"),
        (["--workers", "2"], "--workers is 2"),
        (["--cluster", "127.0.0.1:9", "--workers", "2"], "workers is 2"),
    ],
)
def test_a_cluster_that_is_none_is_refused_in_one_line(film, tmp_path, capsys, options, text):
    out = str(tmp_path / "out")
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}):
        assert main(["film", *map(str, (film / "T.npz", film / "in")), "--out", out, *options]) == 1
    error = capsys.readouterr().err
    assert (text in error, error.count("\n")) == (True, 1), error
    assert not (tmp_path / "out").exists()


def test_a_name_of_no_machine_is_refused_at_once(monkeypatch):
    monkeypatch.setattr("distributed.Client", None)
    with pytest.raises(ClusterError, match=r"cluster is 'nonsense\.invalid:8786'"):
        connect("nonsense.invalid:8786").__enter__()


@pytest.mark.rare
def test_local_workers_have_the_compute_units_of_a_serial_run():
    """Else sums are rounded in another order, and codes of large patterns differ."""
    units = ltcl.open_device().compute_units
    with connect("local", 2) as client:
        client.wait_for_workers(2)
        found: Any = client.run(lambda: importlib.import_module("ltcl").open_device().compute_units)
    assert [*found.values()] == [units, units]
