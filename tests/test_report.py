"""The reports: what they measure, what they say of it, and that they find a defect in the engine."""

import json
import os
import pathlib
import pickle
import re
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.report import CASES
from tiverlet.report.accuracy import baselines, errors, points
from tiverlet.report.accuracy.cases import LEFT_OUT, chosen, entries
from tiverlet.report.stress.certificate import certify
from tiverlet.report.stress.rows import ROWS, Row
from tiverlet.report.stress.rows.row import EXCUSES, at_most, excused

from .conftest import figures


def test_every_known_answer_is_a_case_or_said_to_be_left_out():
    named = {name.partition(":")[0] for name in CASES} | set(LEFT_OUT)
    assert set(entries()) <= named
    assert len(CASES) >= 25 and set(range(1, 71)) <= set(ROWS)
    assert [c.name for c in chosen("D07_massratio_1000")] == [n for n in CASES if n.startswith("D07_massratio_1000")]
    with pytest.raises(ValueError, match="'D99' fits no case. Near it: D0"):
        chosen(["D99"])


@pytest.mark.parametrize("name", CASES)
def test_cases_are_whole_frames_and_know_their_baselines(name):
    case = CASES[name]
    particles, features = case.build()
    assert len(particles) and all(m in tv.report.METHODS for m in case.methods) and case.at in case.efforts
    assert case.frames * case.frame == pytest.approx(case.seconds, rel=1e-9) and set(case.fit) <= set(case.efforts)
    # A second scene of the same case has its own features: a feature cannot act in two worlds.
    assert not set(map(id, features)) & set(map(id, case.build()[1]))


def test_baselines_are_the_textbook_ones():
    # Errors of the prototypes in cases.json, of XPBD with Gauss-Seidel: equal to two digits, since sums have another order.
    for name, t, limit in (("D01_double_pendulum", 2.0, 0.02), ("D05_chain10", 0.5, 0.02)):
        case = CASES[name]
        with baselines.Xpbd(*case.build()) as w:
            errors_ = []
            for w.substeps in (20, 40):
                w.restart()
                for _ in range(case.frames):
                    w.step(case.frame)
                errors_.append(case.error(points.Run(w)))
            assert errors_[0] == pytest.approx(figures(name, t, 20)["XPBD-GS"], rel=limit)
            assert errors_[0] / errors_[1] == pytest.approx(2, abs=0.2)  # first order
    # The article's first step is late by a t dt / 2: 49 mm after 1 s at dt = 0.01.
    with baselines.Article(tv.Particles([[0.0, 0.0]]), [tv.Gravity(9.81)]) as w:
        w.substeps = 1
        for _ in range(100):
            w.step(0.01)
        assert w.position[0, 1] + 9.81 / 2 == pytest.approx(-9.81 * 0.01 / 2, rel=1e-9)
    refuses = baselines.Article.refuses
    assert refuses([tv.Contact()]) and refuses([tv.Distance([[0, 1]], compliance=1.0)]) and not refuses([tv.Gravity()])


@pytest.fixture(scope="module")
def report():
    """Return a small sweep: a double pendulum, and a link that is a spring."""
    return tv.report.error_vs_time(["D01", "S04"], efforts=(10, 20, 40, 80), runs=1)


@pytest.mark.slow
def test_a_sweep_finds_second_order_and_first(report):
    assert not report.failures and not report.missing
    for case in report.cases:
        assert report.order(case, CASES[case].methods[0]) == pytest.approx(2, abs=0.05)
        assert report.order(case, "XPBD") is None or report.order(case, "XPBD") == pytest.approx(1, abs=0.1)
    ours, theirs = report.curve("D01_double_pendulum", "Direct"), report.curve("D01_double_pendulum", "XPBD")
    assert [p.substeps for p in theirs] == [10, 20, 40, 80, 320, 1280] and ours[1].error * 1000 < theirs[1].error
    # Operations: 2 links, 20 substeps in 1/60 s; an elimination counts 2.5.
    assert theirs[1].visits == 2 * 20 * 60 and ours[1].visits == 2.5 * 2 * 20 * 60
    assert all(p.seconds > 0 and p.compile > 0 for p in report.points)
    assert ours[-1].energy < 1e-5 < 1e-2 < theirs[1].energy
    assert any("article on S04" in line for line in report.omissions)
    # At equal work, on any machine: a hundred times less error than textbook XPBD, all along both curves.
    for case in report.cases:
        assert report.advantage(case, CASES[case].methods[0], cost="visits")[1] >= 100


@pytest.mark.slow
def test_a_report_can_be_read_by_people_and_machines(report, tmp_path):
    data = json.loads(report.json())
    assert len(data["points"]) == len(report.points) and not data["failures"] and data["machine"]
    table, text = report.markdown(), str(report)
    assert table.count("\n| ") == 2 + len(report.points) + 1 + len(report.cases) and "D01" in text and "article on S04" in text
    assert max(map(len, text.splitlines())) <= 80 and re.search(r"^D01_double_pendulum +20 .* ok *$", text, re.M)
    pytest.importorskip("matplotlib")
    assert [os.path.getsize(p) > 1000 for p in report.plot(tmp_path / "plots")] == [True, True]


@pytest.mark.slow
def test_wrong_orders_large_errors_and_divergence_are_named(report):
    # The same points, made worse: order 1 instead of 2, an error above the limit, one that has diverged, a loss in f32.
    case, method = "D01_double_pendulum", "Direct"

    def altered(change, precision="f64"):
        some = [change(p) if (p.case, p.method, p.precision) == (case, method, precision) else p for p in report.points]
        return errors.ErrorReport([case], some, [], [], "")

    assert re.search("order 1.0", str(altered(lambda p: replace(p, error=1e-6 * 20 / p.substeps)).failures))
    assert re.search("limit 1e-05", str(altered(lambda p: replace(p, error=10 * p.error)).failures))
    assert re.search("times below its limit of 1e-05", str(altered(lambda p: replace(p, error=p.error / 20)).failures))
    # Points with flags show no order, and a known fault fails once it does not show.
    flagged = altered(lambda p: replace(p, flags=("softened",), error=p.error * (1 + (p.substeps == 10))))
    assert flagged.order(case, method) is None and report.order(case, method) == pytest.approx(2, abs=0.05)
    with pytest.MonkeyPatch.context() as m:
        m.setitem(CASES, case, replace(CASES[case], known="it is wrong"))
        wrong, right = altered(lambda p: replace(p, error=10 * p.error)), altered(lambda p: p)
        assert not wrong.failures and "known fault; it is wrong" in str(wrong)
        assert "strike it in its case: it is wrong" in str(right.failures)
    lost = altered(lambda p: replace(p, error=np.inf, diverged=True))
    assert "diverged at 20" in str(lost.failures) and any("20 substeps: diverged" in line for line in lost.omissions)
    assert json.loads(lost.json())["points"][0]["error"] is None
    assert "f32: error" in str(altered(lambda p: replace(p, error=0.1), "f32").failures)
    # Equal run time: a hundred times the error at the same cost is a factor of a hundred.
    plain = [
        replace(report.points[0], case=case, method="Direct", precision="f64", substeps=n, seconds=n, error=1 / n)
        for n in (1, 2, 4)
    ]
    worse = [replace(p, method="XPBD", error=100 * p.error) for p in plain]
    found = errors.ErrorReport([case], plain + worse, [], [], "").advantage(case, "Direct")
    assert found == pytest.approx((100, 100))


class Deadly:
    """An executor like one of processes, of which one dies in a task."""

    def submit(self, function, task) -> Future:
        out: Future = Future()
        if task.method == "XPBD":
            out.set_exception(BrokenProcessPool("it was killed"))
        else:
            function, task = pickle.loads(pickle.dumps((function, task)))
            out.set_result(pickle.loads(pickle.dumps(function(task))))
        return out


@pytest.mark.slow
def test_sweeps_run_on_any_executor_and_survive_a_worker_that_dies():
    # For the parts that processes and Dask take see test_sweep.py.
    found = tv.report.error_vs_time("D01", methods=["Direct"], precisions=("f64",), efforts=(20, 40), runs=1, executor=Deadly())
    assert [p.substeps for p in found.curve("D01_double_pendulum", "Direct")] == [20, 40]
    assert any(m.task == "D01_double_pendulum, XPBD, f64" for m in found.missing) and "missing" in str(found)
    assert any("BrokenProcessPool" in why for why in found.failures["D01_double_pendulum, XPBD, f64"])


def test_the_certificate_tells_what_holds_and_what_does_not(monkeypatch, tmp_path, capsys):
    def wrong():
        raise RuntimeError("no such luck")

    monkeypatch.setitem(ROWS, 71, Row(71, "a row", "holds", lambda: [("short", False), ("long", True)]))
    monkeypatch.setitem(ROWS, 72, Row(72, "another", "works", wrong))
    monkeypatch.setitem(ROWS, 73, Row(73, "an empty one", "says something", lambda: []))
    monkeypatch.setitem(ROWS, 74, Row(74, "a fault", "is named", lambda: [("off", False), ("on", True)], "it is off"))
    monkeypatch.setitem(ROWS, 75, Row(75, "mended", "is struck", lambda: [("on", True)], "it was off"))
    assert [certify(n).verdict for n in (71, 72, 73, 74, 75)] == ["FAILED"] * 3 + ["known fault", "FAILED"]
    assert certify(74).failing == ("it is off", "off") and "strike it here: it was off" in certify(75).failing[0]
    assert certify(71).failing == ("short",) and "no such luck" in certify(72).failing[0]
    path = str(tmp_path / "certificate.json")
    assert main(["stress", "3", "5", "--workers", "1", "--json", path]) == 0
    assert json.loads(pathlib.Path(path).read_text())["passed"] is True
    capsys.readouterr()
    assert main(["stress", "71", "74", "3", "--workers", "1"]) == 1
    told = capsys.readouterr().out
    assert "1 of 3 passed, 1 with a known fault, 1 failed" in told
    lines = told.splitlines()  # into a pipe: a line a row, in the order in which they finish, before the table, and no bar
    assert [line.split()[:2] for line in lines[:3]] == [["71", "FAILED"], ["74", "known"], ["3", "passed"]]
    assert "Stiff and extreme cases" in lines[3]
    assert main(["stress", "74", "--workers", "1"]) == 0
    with pytest.raises(ValueError, match="rows has 99"):
        tv.report.stress(rows=[99])


def test_limits_see_what_gets_worse():
    # A finding holds within its limit, and as long as the limit is no more than ten times what is reached.
    assert at_most("error", 1e-3, 5e-3) == ("error, limit 0.005", True)
    assert not at_most("error", 6e-3, 5e-3)[1] and not at_most("error", float("nan"), 1.0)[1]
    assert at_most("error", 1e-3, 1e-2)[1] and not at_most("error", 1e-3, 1.01e-2)[1]
    assert not at_most("energy", -1.0, 1e-3)[1] and at_most("energy", -1.0, 0.0)[1]
    assert at_most("rounding", 0.0, 1e-12)[1] and not at_most("rounding", 0.0, 1e-9)[1]
    assert not at_most("error", 1e-3, 5e-3, also=False)[1]


def test_flags_excuse_what_they_name():
    clean = tv.StepReport(0.0, 20, 1, residual=0.04, overlap=0.04)
    assert excused(clean, "residual", 0.05) and not excused(replace(clean, residual=0.06), "residual", 0.05)
    for flag, named in EXCUSES.items():
        for figure in ("residual", "overlap", "energy_change"):
            most = named.get(figure, 0.05)
            for value in (0.9 * most, 1.1 * most):
                found = excused(replace(clean, flags=frozenset([flag]), **{figure: value}), figure, 0.05)
                assert found == (value <= most), (flag, figure, value)
    assert not excused(replace(clean, flags=frozenset(["unconverged"]), residual=180.0), "residual", 0.05)


def test_commands(tmp_path, capsys):
    assert main(["info"]) == 0 and "taichi" in capsys.readouterr().out
    assert main(["report", "--list"]) == 0 and "S05_tennis_racket" in capsys.readouterr().out
    assert main(["report", "nonsense", "--workers", "1"]) == 2 and "fits no case" in capsys.readouterr().err
    assert main(["stress", "--workers", "0"]) == 2
    for name, words in ((str(tmp_path / "none" / "x"), "does not exist"), (str(tmp_path), "is a folder")):
        for command in ("stress", "report"):
            with pytest.raises(SystemExit):
                main([command, "--json", name])
            assert words in capsys.readouterr().err
