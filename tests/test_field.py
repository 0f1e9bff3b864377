# SPDX-License-Identifier: BSD-3-Clause
"""The benchmark of inverse light transport: its files, scores by closed forms, baselines, page."""

from __future__ import annotations

import importlib
import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "guide" / "benchmark.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def modules() -> Any:
    """Modules of `bench/scenes`, by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "bench"))
        names = "tracing", "dataset", "scoring", "baselines"
        yield {name: importlib.import_module(f"scenes.{name}") for name in names}


@pytest.fixture(scope="module")
def scenes(modules: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    data = tmp_path_factory.mktemp("data")
    for name in ("corner", "coloured"):
        modules["dataset"].simulate(data / name, name, 4)
    return modules["dataset"].find_scenes(data)


@pytest.fixture
def method(tmp_path: Path) -> Any:
    """Make a command of lines of Python, which see `transport`, `targets`, `out` and `np`."""

    def make(*lines: str) -> str:
        start = (
            "import sys, pathlib, numpy as np",
            "transport, targets, out = map(pathlib.Path, sys.argv[1:])",
        )
        (tmp_path / "method.py").write_text("\n".join([*start, *lines]))
        return shlex.join([sys.executable, str(tmp_path / "method.py")])

    return make


@pytest.mark.parametrize(("name", "colours"), [("corner", ()), ("coloured", (3,))])
def test_files_have_the_shapes_of_the_readme_and_bounces_add_up(scenes, name, colours) -> None:
    scene = scenes[name]
    h, w = scene.facts["grid"]
    data = scene.photographs
    n = h * w
    assert data["patterns"].shape == data["photographs"].shape == (8, h, w, *colours)
    assert (data["patterns"].min(), data["patterns"].max()) == (0.0, np.float32(0.8))
    assert len(set(data["names"])) == 8
    for measurement in ("first", "second"):
        with np.load(scene.folder / f"{measurement}.npz", allow_pickle=False) as file:
            T = file["T"]
            assert (T.shape, T.dtype, tuple(file["grid"])) == ((*colours, n, n), np.float32, (h, w))
        with np.load(scene.folder / f"{measurement}_bounces.npz", allow_pickle=False) as file:
            direct, *others = (file[f"bounce_{k}"] for k in range(4))
        assert direct.shape == (*colours, n)
        assert {each.shape for each in others} == {(*colours, n, n)}
        rest = T - sum(others)
        rest[..., range(n), range(n)] -= direct
        assert np.linalg.norm(rest) < np.linalg.norm(others[2])
        assert rest.min() > -1e-6


def test_bounces_of_the_corner_are_powers_of_its_matrix(modules, scenes) -> None:
    exact = modules["dataset"].SIMULATED["corner"](4)
    scene = scenes["corner"]
    p = scene.photographs["patterns"]
    light = exact.first_bounce[:, None] * p.reshape(8, -1).T
    for k, found in enumerate(np.moveaxis(scene.bounces("second", p), 1, 0)):
        np.testing.assert_allclose(
            found.reshape(8, -1).T, light, atol=2e-3 * light.max(), err_msg=str(k)
        )
        light = exact.A @ light


@pytest.mark.parametrize("name", ["corner", "coloured"])
def test_a_method_that_writes_the_truth_has_no_error(
    modules, scenes, name, method, tmp_path
) -> None:
    scene = scenes[name]
    scoring = modules["scoring"]
    p = scene.photographs["patterns"]
    np.savez(tmp_path / "truth.npz", patterns=p, bounces=scene.bounces("second", p))
    lines = (
        f"truth = np.load({str(tmp_path / 'truth.npz')!r})",
        "for name in truth: np.save(out / name, truth[name])",
    )
    kept = (
        "(out / 'representation.bin').write_bytes(bytes(1500)), "
        "(out / 'photographs.txt').write_text('7')"
    )
    scores = scoring.run(method(*lines, kept), scene)
    assert max(max(scores[f"bounce {k}"]) for k in range(4)) < 1e-6
    assert max(scores["compensation"]) < 2e-3  # the noise of the judge
    assert (scores["photographs"], scores["MB"]) == (7, 0.0015)
    assert scores["seconds"] > 0
    plain = scoring.run(method(*lines), scene)
    assert plain["photographs"] == scene.facts["grid"][0] * scene.facts["grid"][1]
    assert plain["MB"] == (scene.folder / "first.npz").stat().st_size / 1e6


def test_scores_of_wrong_results_follow_closed_forms(modules, scenes) -> None:
    scene = scenes["corner"]
    scoring = modules["scoring"]
    p = scene.photographs["patterns"]
    true, variance = scene.truth
    random = np.random.default_rng(0)
    std = 1e3 * np.sqrt(variance.max()) * (random.random(true.shape) < 0.9)  # 0: none is stated
    scores = scoring.judge(
        scene,
        {
            "patterns": 0.75 * p,
            "patterns_std": np.where(p > 0.4, 0.3 * p, 0.2 * p),
            "bounces": true + random.standard_normal(true.shape) * np.where(std > 0, std, 9.0),
            "bounces_std": std,
        },
    )
    np.testing.assert_allclose(scores["compensation"], 0.25, atol=2e-3)
    assert scores["patterns within std"] == [pytest.approx(np.mean(p[p > 0] > 0.4)), 1.0]
    assert scores["bounces within std"] == [
        pytest.approx(0.683, abs=0.02),
        pytest.approx(0.954, abs=0.01),
    ]
    too_bright = scoring.judge(scene, {"patterns": p + 9.0})
    white = scoring.judge(scene, {"patterns": np.ones_like(p)})
    assert too_bright == white  # a projector has no more
    halved = scoring.judge(scene, {"patterns": p, "bounces": 0.5 * true})
    np.testing.assert_allclose([halved[f"bounce {k}"] for k in range(4)], 0.5, rtol=1e-3)
    off = np.sqrt(variance[:, 2].sum(axis=(1, 2)) * 4 / (true[:, 2] ** 2).sum(axis=(1, 2)))
    np.testing.assert_allclose(scoring.traced(scene)["bounce 2"], off)  # of the first, not of both


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (["sys.exit('no light')"], "exit status 1, it said: no light"),
        (["raise SystemExit(3)"], "exit status 3"),
        ([], r"patterns\.npy"),
        (["np.save(out / 'patterns', np.zeros((2, 2)))"], r"patterns\.npy is float64 \(2, 2\)"),
        (["np.save(out / 'patterns', np.load(targets) * np.nan)"], r"patterns\.npy .* finite"),
        (["np.save(out / 'patterns', np.array([None]), allow_pickle=True)"], "Object arrays"),
        (
            [
                "np.save(out / 'patterns', np.load(targets))",
                "(out / 'photographs.txt').write_text('few')",
            ],
            "few",
        ),
        (["import time; time.sleep(60)"], "longer than 5 s"),
    ],
)
def test_a_broken_command_is_named(modules, scenes, method, lines, reason) -> None:
    scores = modules["scoring"].run(method(*lines), scenes["corner"], limit=5.0)
    assert list(scores) == ["failed"]
    assert re.search(reason, scores["failed"]), scores


@pytest.mark.rare
def test_a_broken_command_fails_alone(modules, scenes, tmp_path, monkeypatch, capsys) -> None:
    field = importlib.import_module("field")
    found = tmp_path / "found.json"
    arguments = ["--data", str(scenes["corner"].folder.parent), "--json", str(found)]
    arguments += ["--method", "broken=no-such-program", "--method", "dense"]
    monkeypatch.setattr(sys, "argv", ["field.py", *arguments])
    monkeypatch.setattr(modules["tracing"], "unavailable", lambda: "no LLVM")
    with pytest.raises(SystemExit, match=r"corner, broken: .*no-such-program"):
        field.main()
    results = json.loads(found.read_text())["results"]
    assert list(results) == ["corner", "coloured"]
    for methods in results.values():
        assert "failed" in methods["broken"]
        assert max(methods["dense"]["compensation"]) < 0.01
    assert "NOT TRACED" in capsys.readouterr().out


@pytest.mark.rare
@pytest.mark.parametrize(
    ("name", "scene", "most"),
    [
        ("iteration", "coloured", 0.01),
        ("dense", "coloured", 0.01),
        ("threshold", "coloured", 0.3),
        ("ltcl", "corner", 0.01),
        ("ltcl compressed", "corner", 0.02),
    ],
)
def test_baselines_compensate_and_separate(modules, scenes, name, scene, most) -> None:
    command = importlib.import_module("field").commands([name])[name]
    scores = modules["scoring"].run(command, scenes[scene])
    assert "failed" not in scores, scores
    assert max(scores["compensation"]) < most
    assert max(scores["bounce 0"]) < most + 0.02  # the diagonal holds light that came back
    # ltcl states deviations where T of so few pixels shows its noise.
    assert name.startswith("ltcl") or "bounces within std" not in scores


def test_the_iteration_says_that_it_does_not_converge(modules) -> None:
    T = np.array([[1.0, 0.9, 0.9], [0.9, 1.0, 0.9], [0.9, 0.9, 1.0]])  # R has the eigenvalue 1.8
    _, solve = modules["baselines"].iteration(T, Path())
    with pytest.raises(SystemExit, match="does not converge"):
        solve(np.ones((3, 1)))


def test_the_table_of_the_page_is_that_of_the_record(modules) -> None:
    record = json.loads((ROOT / "bench" / "results" / "scenes.json").read_text("utf-8"))
    assert list(record["results"]) == list(modules["dataset"].NAMES)
    assert modules["scoring"].markdown(record["results"]) in PAGE


def test_the_method_on_the_page_runs(modules, scenes, tmp_path) -> None:
    (tmp_path / "mine.py").write_text(re.findall(r"```py\n(.*?)```", PAGE, re.DOTALL)[0])
    for scene in scenes.values():
        scores = modules["scoring"].run(
            shlex.join([sys.executable, str(tmp_path / "mine.py")]), scene
        )
        assert max(scores["compensation"]) < 0.01
        assert "bounce 0" not in scores
