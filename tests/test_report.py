import base64
import json
import shlex
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_logs import made_log, pair

from lwa4d_sim.drawing import Picture
from lwa4d_sim.errors import RecordError
from lwa4d_sim.expect import Outcome, evaluate
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.page import NONE, number
from lwa4d_sim.plots import draw_all
from lwa4d_sim.record import RunLog
from lwa4d_sim.report import Section, bound, section_from_folder, write_report
from lwa4d_sim.verdict import Run, headline, remarks

_RULES: dict[str, dict[str, Any]] = {"ideal": {"stable": True}, "can": {"stable": True, "final_error_max": [0.1, None]}}
_HOSTILE = "<script>alert(1)</script>\"'><img src=http://evil.example/x onerror=y>{{ 7*7 }}"
_VOID = {"meta", "link", "img", "br"}


class _Page(HTMLParser):
    """Tags, links, texts and ids of a page; fails on tags that do not close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.handlers: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for key, value in attrs:
            if key in ("src", "href", "srcset", "action", "data", "poster"):
                self.links.append(value or "")
            if key == "id":
                self.ids.append(value or "")
            if key.startswith("on"):
                self.handlers.append(key)
        if tag not in _VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def _section(logs: dict[str, RunLog], figures: list[Picture], **changes: Any) -> Section:
    runs = {
        name: Run.of(log, log.metrics(), evaluate(_RULES.get(name, {}), log.metrics())) for name, log in logs.items()
    }
    values: dict[str, Any] = {
        "title": "made",
        "runs": runs,
        "scenario": "name: made\n",
        "source": "scenarios/made.yaml",
        "overrides": {"controller.kp": 2.0},
        "versions": {"lwa4d_sim": "0.1.0"},
        "figures": figures,
    }
    return Section(**(values | changes))


def _write_folder(folder: Path, logs: dict[str, RunLog]) -> dict[str, Any]:
    folder.mkdir(exist_ok=True)
    variants = {}
    for name, log in logs.items():
        log.save(folder / f"{name}.h5")
        checks = evaluate(_RULES.get(name, {}), log.metrics())
        expect = {"passed": all(c.passed for c in checks), "checks": [asdict(c) for c in checks]}
        variants[name] = {"metrics": log.metrics(), "expect": expect}
    summary = {
        "name": "made",
        "variants": variants,
        "versions": {"lwa4d_sim": "0.1.0"},
        "scenario": "name: made\n",
        "source": "scenarios/made.yaml",
        "overrides": {"controller.kp": 2.0},
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return summary


def _page(path: Path, sections: list[Section]) -> _Page:
    write_report(path, sections)
    return _Page(path.read_text(encoding="utf-8"))


def test_the_page_holds_everything_and_needs_nothing(tmp_path: Path) -> None:
    logs = pair()
    figures = draw_all(logs, tmp_path)
    page = _page(tmp_path / "report.html", [_section(logs, figures)])
    images = [link for link in page.links if link.startswith("data:image/png;base64,")]
    assert [base64.b64decode(link.split(",")[1]) for link in images] == [f.path.read_bytes() for f in figures]
    assert set(page.links) - set(images) == {"data:,"}
    assert "script" not in page.tags
    for text in (
        "shakes from",
        "1 of 3 expectations failed",
        f"final_error ≤ 0.1, {NONE} m",
        "brakes released",
        "seed 7",
    ):
        assert text in page.text
    for key in logs["can"].metrics():
        assert key in page.text
        assert METRICS[key][1] in page.text
    assert list(tmp_path.glob("*.part")) == []


def test_what_users_write_is_text_and_never_markup(tmp_path: Path) -> None:
    log = made_log(_HOSTILE, events=((0.1, _HOSTILE),))
    runs = {_HOSTILE: Run.of(log, log.metrics(), [Outcome(_HOSTILE, _HOSTILE, _HOSTILE, False)])}
    figure = draw_all({"can": log}, tmp_path)[0]._replace(title=_HOSTILE, caption=_HOSTILE)
    section = Section(
        title=_HOSTILE,
        runs=runs,
        scenario=_HOSTILE,
        source=_HOSTILE,
        overrides={_HOSTILE: _HOSTILE},
        versions={_HOSTILE: "\ud800"},
        figures=[figure],
    )
    page = _page(tmp_path / "report.html", [section, section])
    assert "script" not in page.tags
    assert page.handlers == []
    assert all(link.startswith(("data:", "#")) for link in page.links)
    assert page.tags.count("img") == 2
    assert page.text.count(_HOSTILE) > 20


def test_several_scenarios_begin_with_a_table_that_leads_to_each(tmp_path: Path) -> None:
    logs = pair()
    sections = [_section(logs, []), _section({"ideal": logs["ideal"]}, [], title="calm")]
    page = _page(tmp_path / "report.html", sections)
    links = [link for link in page.links if link.startswith("#")]
    assert links == ["#s1", "#s2"]
    assert page.ids == ["s1", "s2"]
    assert "1 expectation met" in page.text


def test_a_folder_gives_the_section_that_was_put_in(tmp_path: Path) -> None:
    logs = pair()
    folder = tmp_path / "made"
    _write_folder(folder, logs)
    drawn = section_from_folder(folder)  # draws, for there are no figures
    assert drawn == _section(logs, list(drawn.figures))
    assert [f.path.parent for f in drawn.figures] == [folder] * 5
    for figure in drawn.figures[1:]:
        figure.path.unlink()
    assert section_from_folder(folder).figures == drawn.figures[:1]  # takes what there is


def _break(folder: Path, summary: dict[str, Any], how: str) -> None:
    if how == "no summary":
        (folder / "summary.json").unlink()
    elif how == "no record":
        (folder / "can.h5").unlink()
    elif how == "broken record":
        (folder / "can.h5").write_bytes(b"nothing")
    else:
        texts = {
            "not JSON": "{",
            "not a mapping": "[1]",
            "no name": json.dumps({k: v for k, v in summary.items() if k != "name"}),
            "no variant": json.dumps(summary | {"variants": {}}),
            "no metrics": json.dumps(summary | {"variants": {"can": {"expect": {"checks": []}}}}),
            "no verdict": json.dumps(
                summary | {"variants": {"can": {"metrics": {}, "expect": {"checks": [{"key": "stable"}]}}}}
            ),
        }
        (folder / "summary.json").write_text(texts[how])


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("no summary", r"made: not a finished run: cannot read summary.json \(No such file"),
        ("no record", r"can\.h5: not a readable run record"),
        ("broken record", r"can\.h5: not a readable run record"),
        ("not JSON", r"summary\.json: not valid JSON"),
        ("not a mapping", r"summary\.json: 'variants' is missing or not a mapping"),
        ("no name", r"summary\.json: 'name' is missing or not text"),
        ("no variant", r"summary\.json: 'variants' is empty"),
        ("no metrics", r"summary\.json: variant 'can': 'metrics' is missing or not a mapping"),
        ("no verdict", r"summary\.json: variant 'can': 'passed' is missing or not true or false"),
    ],
)
def test_a_folder_that_is_no_run_is_named_with_what_it_lacks(tmp_path: Path, how: str, message: str) -> None:
    folder = tmp_path / "made"
    summary = _write_folder(folder, pair())
    _break(folder, summary, how)
    with pytest.raises(RecordError, match=message) as caught:
        section_from_folder(folder)
    assert "\n" not in str(caught.value)


def test_a_page_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    section = _section({"can": made_log()}, [])
    with pytest.raises(RecordError, match="cannot write the report"):
        write_report(tmp_path / "absent" / "report.html", [section])
    lost = replace(section, figures=[Picture(tmp_path / "lost.png", "", "")])
    with pytest.raises(RecordError, match=r"lost\.png"):
        write_report(tmp_path / "report.html", [lost])
    (tmp_path / "folder").mkdir()
    with pytest.raises(RecordError, match="cannot write the report"):
        write_report(tmp_path / "folder", [section])
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, NONE),
        (True, "yes"),
        (False, "no"),
        (0.0, "0"),
        (0.036849, "0.0368"),
        (3.93e-8, "3.93e-08"),
        (372.4, "372"),
        (20001.4, "20001"),
        (-1234567.0, "-1.23e+06"),
        (float("inf"), "inf"),
        ([0.0252, None, 1], f"0.0252, {NONE}, 1"),
        ([], ""),
        ("text", "text"),
    ],
)
def test_numbers_in_tables(value: Any, text: str) -> None:
    assert number(value) == text


def test_bounds_read_like_bounds() -> None:
    assert bound(Outcome("final_error_max", 0.01, None, False)) == "final_error ≤ 0.01 m"
    assert bound(Outcome("saturation_fraction_min", 0.5, None, False)) == "saturation_fraction ≥ 0.5"
    assert bound(Outcome("stable", True, True, True)) == "stable = yes"


def test_the_command_gives_the_overrides_back() -> None:
    overrides = {"controller.kp": [1.0, 2.0], "arm": "it's $HOME"}
    section = _section({"can": made_log()}, [], overrides=overrides, source="my scenarios/a.yaml")
    words = shlex.split(section.command)
    assert words[:3] == ["lwa4d-sim", "run", "my scenarios/a.yaml"]
    pairs = [word.split("=", 1) for word in words[3:] if word != "--set"]
    assert {key: json.loads(value) for key, value in pairs} == overrides


_BUS: dict[str, Any] = {"period": 0.01, "knots": [5.0, 10.0, 15.0, 20.0]}


def _run(kind: str = "sampled", **metrics: Any) -> Run:
    calm = {"stable": True, "unstable_since": None, "diverged_at": None}
    return Run(metrics=calm | metrics, settings={"loop": {"kind": kind}}, **_BUS)


@pytest.mark.parametrize(
    ("runs", "sentence"),
    [
        ({"default": _run()}, "Under the 10 ms bus the arm moves without lasting vibration."),
        (
            {"ideal": _run("ideal"), "can": _run(stable=False, unstable_since=15.14)},
            "Under the 10 ms bus (can) the arm shakes from 15.1 s on (waypoint 4); "
            "without the bus (ideal) it does not.",
        ),
        (
            {"a": _run("ideal"), "b": _run("canopen"), "c": _run()},
            "Without the bus (a), under the 10 ms CANopen bus (b) and under the 10 ms bus (c) the arm moves without "
            "lasting vibration.",
        ),
        (
            {"a": _run(stable=False, unstable_since=5.0, diverged_at=6.5), "b": _run(stable=False, unstable_since=1.0)},
            "Under the 10 ms bus (a) the arm shakes from 5.0 s on (waypoint 2) and leaves all bounds at 6.5 s, where "
            "the run ends; under the 10 ms bus (b) it shakes from 1.0 s on (waypoint 1).",
        ),
        (
            {"x": _run(stable=False, unstable_since=20.0, diverged_at=20.0)},
            "Under the 10 ms bus the arm runs away and leaves all bounds at 20.0 s (waypoint 4), where the run ends.",
        ),
    ],
)
def test_the_headline_says_what_happened(runs: dict[str, Run], sentence: str) -> None:
    assert headline(runs) == sentence


def test_next_sync_and_foreign_motions_are_named() -> None:
    settings = {"loop": {"actuation": "next_sync"}, "trajectory": {"kind": "fourier"}}
    run = replace(_run(stable=False, unstable_since=7.0), settings=settings)
    assert run.link == "under the 10 ms bus, commands acting at the next SYNC"
    assert run.fate == "shakes from 7.0 s on (segment 2)"


def test_remarks_tell_accuracy_cost_and_saturation() -> None:
    runs = {
        "ideal": _run("ideal", final_error=[0.01, None], saturation_fraction=0.0),
        "can": _run(
            stable=False,
            unstable_since=15.1,
            final_error=[0.02, 1.5],
            deviation=[0.004, 0.006, 0.005, 0.9],
            saturation_fraction=0.25,
        ),
    }
    assert remarks(runs) == [
        "Largest distance of the tool from its goal at the end of a segment: 10 mm (ideal), 1.5 m (can).",
        "Largest distance of the tool from the ideal run before anything shakes: 6 mm (can).",
        "Share of the time that the motors spend at their torque limits: 25 % (can).",
    ]
    assert remarks({"default": _run(final_error=[None])}) == []
    assert "segment: less than 0.001 mm (x)." in remarks({"x": _run(final_error=[6e-8])})[0]


def test_a_diverged_run_has_a_section_without_numbers_that_do_not_exist(tmp_path: Path) -> None:
    log = made_log(steps=3300, shakes_from=2.5, diverged_at=3.3)
    section = _section({"can": log}, [])
    page = _page(tmp_path / "report.html", [section])
    assert "diverged_at" in page.text
    assert "leaves all bounds at 3.3 s" in section.headline
    assert "NaN" not in page.text
    assert "nan" not in page.text
    assert np.isfinite(log.metrics()["max_error"])
