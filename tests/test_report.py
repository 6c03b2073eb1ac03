"""The report: nothing lost in drawing, nothing unescaped, words before figures, and a page that a browser draws."""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects as go
import pytest
from scipy.spatial.transform import Rotation

from tbmfg.report import Report
from tbmfg.report.content import rotation_sd_n
from tbmfg.report.page import figures
from tbmfg.report.panels import COLOURS, log_ticks, pens
from tbmfg.report.paths import angle_rates
from tbmfg.report.tables import calibrations, known
from tbmfg.report.thin import band, broken, extremes, packed, segments
from tbmfg.report.timeline import merged, present
from tbmfg.report.words import findings
from tbmfg.state import Calibrated, Counts, Innovations, Interval, Result, Trajectory, Truth

EPOCH_NS = 1_700_000_000_000_000_000
WILD = 'evil </script><script>alert("x")</script> & <b>bold</b>.mcap'
SUMMARY = {
    "log": WILD, "rig": "toy", "truth": "/truth/<i>pose</i>", "duration_s": 60.0, "keyframes": 600, "wall_s": 3.0,
    "shared_s": 1.0, "options": {"outages": [("prism", 10.0, 20.0)], "without": (), "set": ["lag_s=3"]},
    "warnings": ["prism: 3 samples lost", "prism.arm_z is not observable"],
    "calibration": {"prism_lever_arm_m": {"value": [0.1, 0.2, 0.3], "sd": [0.01, 0.01, 0.02], "estimated": True},
                    "noise_factor": {"value": 2.0, "sd": 0.0, "estimated": False}},
    "sensors": {"prism": {"received": 9, "used": 7, "gated": 2, "late": 0, "duplicate": 0, "nonfinite": 0, "outage": 0,
                          "unused": 0}},
    "intervals": [{"sensor": "prism", "kind": "outage", "start_s": 10.0, "end_s": 20.0},
                  {"sensor": "zero_velocity", "kind": "standing", "start_s": 0.0, "end_s": 4.0}],
    "metrics": {"ape_rms_m": 0.004, "position_rms_m": 0.005, "outage_position_rms_m": 0.02, "attitude_rms_deg": 0.3,
                "yaw_rms_deg": 0.2, "velocity_rms_mps": None, "nees_mean": 31.0, "nees_n_eff": 20.0, "nees_dof": 6},
}  # fmt: skip


def trajectory(n: int = 600, far: float = 0.0) -> Trajectory:
    rng = np.random.default_rng(1)
    s = np.linspace(0.0, 60.0, n)
    return Trajectory(
        t_ns=EPOCH_NS + (s * 1e9).astype(np.int64),
        position_n=np.column_stack([s + far, 5 * np.sin(s / 9), 0.1 * rng.standard_normal(n)]),
        quat_xyzw=Rotation.from_euler("ZYX", np.column_stack([s / 30, 0 * s, 0 * s])).as_quat(),
        velocity_n=np.zeros((n, 3)),
        bias_acc=np.zeros((n, 3)),
        bias_gyro=np.zeros((n, 3)),
        cov=np.tile(1e-4 * np.eye(15), (n, 1, 1)),
    )


def report(n: int = 600, estimators: int = 2, far: float = 0.0, **options) -> Report:
    made = Report(
        WILD, "name: toy\ntopic: </pre><script>alert(1)</script>\n", EPOCH_NS,
        stamps_s={"imu": np.arange(0, 60, 0.005), "prism": np.arange(0, 30, 0.2), "laser": np.zeros(0)},
        found=("prism: 3 samples lost",), **options,
    )  # fmt: skip
    path = trajectory(n, far)
    truth = Truth(path.t_ns, path.position_n + 0.01, path.quat_xyzw)
    nis = np.random.default_rng(2).chisquare(3, n)
    for k in range(estimators):
        smoothed = replace(path, position_n=path.position_n + 0.001) if k else None
        result = Result(f"estimator-{k}", path, smoothed=smoothed)
        result.calibration["prism_lever_arm_m"] = Calibrated((0.1, 0.2, 0.3), (0.01, 0.01, 0.02), True)
        result.counts["prism"] = Counts(received=9, used=7, gated=2)
        result.innovations["prism"] = Innovations(path.t_ns, nis, 3, nis > 16.27)
        result.intervals.append(Interval("prism", "outage", EPOCH_NS, EPOCH_NS + 1))
        more = {"metrics_smoothed": SUMMARY["metrics"] | {"nees_mean": 6.0}} if k else {}
        made.add(result, SUMMARY | {"estimator": result.estimator} | more, truth)
    made.summaries["shearer-afkf"] = {"not_run": "needs odometer <& more>"}
    return made


def drawn(made: Report) -> list:
    return figures(made, pens([(track.label, track.estimator, track.smoothed) for track in made.tracks]))


class Structure(HTMLParser):
    """Headings and the balance of elements; script contents are opaque, as they are to a browser."""

    VOID = frozenset({"meta", "br"})

    def __init__(self):
        super().__init__()
        self.open, self.headings, self.scripts, self.text = [], [], [], ""

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")
        assert not {"src", "href"} & {name for name, _ in attrs}, "the page needs nothing from elsewhere"

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif self.open and self.open[-1] not in ("style",):
            self.text += data
            if self.open[-1] in ("h1", "h2"):
                self.headings.append(data)


def parsed(html: str) -> Structure:
    structure = Structure()
    structure.feed(html)
    structure.close()
    assert structure.open == []
    return structure


# ---- drawing ----


def test_thinning_keeps_both_ends_and_every_extreme():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((10_007, 2))
    values[5000, 1] = 99.0
    rows = extremes(values, 100)
    assert rows[0] == 0
    assert rows[-1] == 10_006
    assert 5000 in rows
    assert len(rows) <= 2 * 2 * 100 + 2
    size = -(-10_007 // 100)
    for first in range(0, 10_007, size):
        kept = values[rows[(rows >= first) & (rows < first + size)]]
        whole = values[first : first + size]
        assert (kept.max(axis=0) == whole.max(axis=0)).all()
        assert (kept.min(axis=0) == whole.min(axis=0)).all()


def test_little_is_not_thinned_and_nan_is_no_extreme():
    assert len(extremes(np.zeros(900), 500)) == 900
    assert len(extremes(np.zeros(0))) == 0, "a sensor of which every row is gated"
    values = np.full(5000, np.nan)
    values[1234] = 1.0
    assert 1234 in extremes(values, 100)


def test_lines_break_where_nothing_was_recorded():
    t_s = np.concatenate([np.arange(0, 10, 0.1), np.arange(20, 30, 0.1)])
    segment = segments(t_s)
    assert segment.max() == 1
    x, _ = broken(segment, t_s, t_s)
    assert np.flatnonzero(np.isnan(x)).tolist() == [100]
    x, y = band(segment, t_s, t_s - 1, t_s + 1)
    assert np.isnan(x).sum() == 2
    assert np.nanmax(y) == t_s[-1] + 1
    assert [(round(a, 6), round(b, 6)) for a, b in present(t_s)] == [(0.0, 9.9), (20.0, 29.9)]
    assert merged([(5.0, 5.0), (0.0, 1.0), (1.05, 2.0)], 0.1) == [(0.0, 2.0), (5.0, 5.1)]


@pytest.mark.parametrize("values", [[0.0, 1.0], [5_000_000.0, 5_000_000.002], [np.nan, 3.0], [], [1e300, 0.0]])
def test_arrays_are_packed_as_finely_as_a_plot_shows(values):
    import base64

    made = packed(np.array(values))
    back = np.frombuffer(base64.b64decode(made["bdata"]), "<" + made["dtype"]).astype(float)
    span = np.ptp(np.array(values)[np.isfinite(values)]) if np.isfinite(values).any() else 0.0
    assert np.allclose(back, values, rtol=0, atol=1e-4 * span, equal_nan=True)


def test_angle_rates_against_differences():
    """A small turn d about b's axes: R Exp(d); truncation d |second derivative|, below 3 d here."""
    angles = np.array([[0.3, -0.4, 1.1]])
    R, step = Rotation.from_euler("ZYX", angles[:, ::-1]), 1e-6
    for axis in range(3):
        turned = R * Rotation.from_rotvec(step * np.eye(3)[axis])
        numeric = (turned.as_euler("ZYX")[0, ::-1] - angles[0]) / step
        assert np.abs(numeric - angle_rates(angles)[0, :, axis]).max() < 3 * step + 1e-9


def test_heading_sd_of_a_body_on_its_side():
    R = Rotation.from_euler("x", [90], degrees=True).as_matrix()[None]
    sd = rotation_sd_n(R, np.diag([1.0, 4.0, 9.0])[None])
    assert np.allclose(sd, [[1.0, 3.0, 2.0]])  # b's y axis points up


def test_plotly_knows_every_part_of_the_figures():
    points = np.random.default_rng(0).normal(size=(100, 3))
    for figure in drawn(report(map_n=points)):
        go.Figure(data=figure.data, layout=figure.layout)  # raises for an attribute that does not exist


def test_estimators_keep_their_colour_and_causal_ones_are_dotted():
    pen = pens([("a", "a", False), ("b (causal)", "b", False), ("b (last)", "b", True)])
    assert pen["a"].colour == COLOURS[0]
    assert pen["b (causal)"].colour == pen["b (last)"].colour == COLOURS[1]
    assert (pen["b (causal)"].dash, pen["b (last)"].dash) == ("dot", "solid")
    many = pens([(str(k), str(k), False) for k in range(15)])
    assert len({(p.colour, p.dash) for p in many.values()}) == 15


@pytest.mark.parametrize(("low", "high"), [(0.05, 1.2), (1.2, 1.5), (1.0, 1.001), (1e-6, 1e3), (7.0, 35.0)])
def test_a_logarithmic_axis_has_ticks_that_fit_beside_each_other(low, high):
    made = log_ticks(low, high)
    first, last = made["range"]
    assert first < np.log10(low) < np.log10(high) < last
    ticks = np.log10(made["tickvals"])
    assert 2 <= len(ticks) <= 11
    assert first < ticks.min() < ticks.max() < last
    assert np.diff(ticks).min() > (last - first) / 15 or high / low < 1.1  # of 130 pixels
    assert len(set(made["ticktext"])) == len(ticks)


@pytest.mark.parametrize(
    ("value", "sd", "shown"),
    [(0.092941, 0.003548, "0.0929 ± 0.0035"), (1.0, 0.0999, "1.000 ± 0.100"), (1234.5, 56.0, "1234 ± 56"),
     (0.5, 0.0, "0.5 ± 0"), (2e-12, 3e-11, "2e-12 ± 3e-11")],
)  # fmt: skip
def test_calibrations_have_the_digits_that_are_known(value, sd, shown):
    assert re.sub("<.*?>", "", known(value, sd)) == shown


@pytest.mark.parametrize(
    ("verdicts", "shown"),
    [((True, True), "yes"), ((None, True), "yes"), (((True, True, False), (True, True, False)), "yes yes no"),
     ((True, False), "a: yes b: no"), ((None, None), "–")],
)  # fmt: skip
def test_what_the_log_told_is_a_column_of_its_own(verdicts, shown):
    own = {
        name: {"calibration": {"odometer_scale": {"value": 0.0, "sd": 1.0, "estimated": True, "observed": told}}}
        for name, told in zip("ab", verdicts, strict=True)
    }
    page = calibrations(Report("toy", "", 0, summaries=own), {})
    assert "<th scope=col>told by the log</th>" in page
    assert " ".join(re.sub("<.*?>", " ", page.rpartition("<td>")[2]).split()) == shown


# ---- words ----


def test_words_come_in_order_of_importance_and_once():
    groups = {group.heading: group.lines for group in findings(report())}
    assert list(groups) == [
        "Result",
        "Not run",
        "Surer than it should be",
        "What the estimators warn of",
        "What the log and the rig gave rise to",
    ]
    assert groups["What the estimators warn of"] == ["estimator-0, estimator-1: prism.arm_z is not observable"]
    assert groups["What the log and the rig gave rise to"] == ["prism: 3 samples lost"]
    assert "17.3 mm" in groups["Result"][0]  # sqrt(3) x 1 cm
    assert "off by 5 mm rms, 20 mm in the outages, and by 0.2° in heading" in groups["Result"][0]
    # sqrt(31 / 6) times; the last estimates of the other, at 6, are as sure as they should be
    assert [line[:40] for line in groups["Surer than it should be"]] == [
        "estimator-0: its errors are 2.3 times wh",
        "estimator-1 (causal): its errors are 2.3",
    ]


def test_an_estimator_without_covariance_claims_nothing():
    made, path = Report("toy", "", EPOCH_NS), trajectory()
    made.add(Result("sbm-cf", replace(path, cov=0 * path.cov)), SUMMARY | {"estimator": "sbm-cf"}, None)
    assert findings(made)[0].lines[0].startswith("sbm-cf: does not say how sure it is; against the truth")


def test_without_truth_the_report_says_so():
    made = Report("toy", "", EPOCH_NS)
    made.add(Result("batch", trajectory()), SUMMARY | {"metrics": None, "truth": None}, None)
    assert "no truth" in findings(made)[0].lines[-1]
    page = made.html()
    assert "Errors against the truth" not in page
    assert "Without a truth there are no errors to set side by side" in page


# ---- the page ----


def test_page_is_whole_and_nothing_from_the_log_is_taken_for_html():
    made = report()
    made.stamps_s = {"imu": made.stamps_s["imu"], "prism<script>": made.stamps_s["prism"]}
    page = parsed(made.html())
    assert page.headings[:3] == [WILD, "Diagnosis", "Comparison"]
    assert page.headings[-1] == "Configuration"
    assert len(page.scripts) == 3  # plotly, figures, ours
    assert "topic: </pre><script>alert(1)</script>" in page.text
    figures_json = page.scripts[1]
    assert "<" not in figures_json
    labels = re.findall(r"<\w", json.dumps(json.loads(figures_json)).replace("<b>", "").replace("<br>", ""))
    assert labels == []


def test_far_coordinates_are_drawn_to_the_millimetre():
    made = report(far=5_431_234.0)
    plan = next(figure for figure in drawn(made) if figure.title == "Plan")
    assert {trace["x"]["dtype"] for trace in plan.data} == {"f8"}
    space = next(figure for figure in drawn(made) if figure.title == "In space")
    assert space.layout["scene"]["xaxis"]["title"]["text"] == "x − 5431300, m"


def test_the_states_of_a_shaft_machine_are_shown_where_there_are_any():
    made = report()
    state = {"start_s": 0.0, "end_s": 9.0, "level": "stop", "case": 3, "direction": "up <left>", "spot_mm": [1.0, -2.5]}
    normal = state | {"start_s": 9.0, "end_s": 10.0, "level": "normal", "case": None}
    told = {"timeline": [state, normal], "level_s": {"normal": 1.0, "troubleshoot": 0.0, "stop": 9.0}}
    made.summaries["estimator-0"] = made.summaries["estimator-0"] | {"deviation": told}
    figure = next(figure for figure in drawn(made) if figure.title.startswith("Deviation"))
    assert [trace["name"] for trace in figure.data] == ["normal", "troubleshoot", "stop"]
    assert "direction: up &lt;left&gt;<br>spot, mm: 1, -2.5" in figure.data[2]["text"][0]
    page = parsed(made.html()).text
    assert "estimator-0 outside of normal" in page
    assert "0.0 – 9.0stop3up <left>1, -2.5" in page


def test_an_hour_at_ten_hertz_stays_small():
    """Whatever its length, a trajectory takes at most a megabyte beside plotly's five, so ten of them stay below 15."""
    made = report(n=36_000, estimators=1)
    html = made.html()
    assert len(html.encode()) < 5e6 + 1e6 * len(made.tracks)
    assert "Drawn with one point in" in html


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the report in")
def test_a_browser_draws_it_without_complaint_and_without_a_network(tmp_path):
    (tmp_path / "report.html").write_text(report(map_n=np.random.default_rng(0).normal(size=(500, 3))).html(), "utf-8")
    ran = subprocess.run(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--enable-logging=stderr", "--host-resolver-rules=MAP * ~NOTFOUND",
            f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1280,9000",
            "--virtual-time-budget=20000", "--dump-dom",
            (tmp_path / "report.html").as_uri(),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    said = [line for line in ran.stderr.splitlines() if "CONSOLE" in line]
    # what the software renderer says of its own speed is no fault of the page
    assert [line for line in said if "GPU stall" not in line and "willReadFrequently" not in line] == []
    count = len(drawn(report()))
    assert f'data-drawn="{count}"' in ran.stdout
    assert ran.stdout.count("js-plotly-plot") >= count
    assert 'data-title="Share' not in ran.stdout  # no figure offers to be sent anywhere
