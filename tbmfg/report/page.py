"""The page itself: what is said, in which order, how it looks on a screen and on paper."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from html import escape

from tbmfg import __version__
from tbmfg.comparison import not_run, ran
from tbmfg.report import accuracy, paths, tables, timeline
from tbmfg.report.content import Report
from tbmfg.report.panels import TIME, Figure, Pen, pens
from tbmfg.report.words import findings
from tbmfg.timeseries import NS

STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 1.5rem; max-width: 1060px; background: #fff; color: #222;
       font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .6rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .4rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin: 1rem 0 .2rem; }
ul { margin: .2rem 0; padding-left: 1.3rem; }
li { overflow-wrap: anywhere; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: 0; }
dt { color: #555; } dd { margin: 0; overflow-wrap: anywhere; }
table { border-collapse: collapse; font-size: .9rem; }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #ddd; vertical-align: top;
         white-space: nowrap; }
th:first-child { text-align: left; }
th { font-weight: 600; }
thead th { border-bottom: 2px solid #888; white-space: normal; vertical-align: bottom; }
small { color: #555; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; font-size: .8rem; background: #f6f6f6; padding: .8rem; }
.wide { overflow-x: auto; }
.note, figcaption { color: #555; font-size: .85rem; }
.grave { border-left: 5px solid #D55E00; padding-left: .8rem; }
.stacked td small { display: block; }
.swatch { display: inline-block; width: 1.6rem; margin-right: .4rem; vertical-align: middle; }
figure { margin: 0; } figure + .wide { margin-top: .8rem; }
@page { size: A4; margin: 12mm; }
@media print {
  body { padding: 0; width: 1000px; max-width: none; font-size: 15px; }
  figure, tr, li { break-inside: avoid; }
  h2, h3, figcaption { break-after: avoid; }
  .wide { overflow: visible; }
  .modebar { display: none; }
}
"""

# One figure after the other, so that the page answers meanwhile, and the one in space when it is scrolled to: without a
# graphics card it takes long. Nothing is ever sent anywhere.
SCRIPT = """
const unseen = new Map();
const waiting = JSON.parse(document.getElementById("figures").textContent);
const options = {responsive: true, displaylogo: false, plotlyServerURL: "",
                 modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d"]};
function draw(k) {
  if (k === waiting.length) { document.body.dataset.drawn = String(k); return; }
  const plot = document.getElementById("figure" + k), {data, layout} = waiting[k];
  const next = () => setTimeout(draw, 0, k + 1);
  if (!layout.scene) { Plotly.newPlot(plot, data, layout, options).then(next); return; }
  unseen.set(plot, () => { unseen.delete(plot); watch.unobserve(plot); Plotly.newPlot(plot, data, layout, options); });
  watch.observe(plot);
  next();
}
const watch = new IntersectionObserver(seen => {
  for (const one of seen) if (one.isIntersecting && unseen.has(one.target)) unseen.get(one.target)();
});
draw(0);
function width(px) {
  for (const plot of document.querySelectorAll(".js-plotly-plot")) {
    Plotly.relayout(plot, {width: px, autosize: px === null});
  }
}
addEventListener("beforeprint", () => {
  for (const part of document.querySelectorAll("details")) part.open = true;
  for (const show of [...unseen.values()]) show();
  width(1000);
});
addEventListener("afterprint", () => width(null));
"""


def page(report: Report) -> str:
    """The report as one HTML document that needs nothing else: plotly's JavaScript is in it."""
    from plotly.offline import get_plotlyjs

    pen = pens([(track.label, track.estimator, track.smoothed) for track in report.tracks])
    drawn = figures(report, pen)
    title = f"{report.title}: where it was, and how sure that is"
    return "".join(
        [
            "<!doctype html>\n<html lang=en><head><meta charset=utf-8>",
            '<meta name=viewport content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body>\n",
            f"<header><h1>{escape(report.title)}</h1>{_facts(report)}</header>\n",
            f"<section id=diagnosis><h2>Diagnosis</h2>{_words(report)}</section>\n",
            f"<section id=comparison><h2>Comparison</h2>{tables.comparison(report, pen)}</section>\n",
            *(_figure(number, figure) for number, figure in enumerate(drawn)),
            f"<section id=calibration><h2>Calibrations</h2>{tables.calibrations(report, pen)}</section>\n",
            f"<section id=samples><h2>Where every sample went</h2>{tables.counts(report)}</section>\n",
            "<section id=configuration><h2>Configuration</h2><details><summary>The rig in effect</summary>",
            f"<pre>{escape(report.rig_yaml)}</pre></details></section>\n",
            "<noscript><p>The figures need JavaScript; words and tables do not.</p></noscript>\n",
            f"<script>{get_plotlyjs()}</script>\n",
            f"<script type=application/json id=figures>{_json(drawn)}</script>\n<script>{SCRIPT}</script>\n",
            "</body></html>\n",
        ]
    )


def figures(report: Report, pen: dict[str, Pen]) -> list[Figure]:
    """All that this report's content can fill, in the order of the page."""
    order: Sequence[Callable[[Report, dict[str, Pen]], Figure | None]] = (
        paths.plan,
        paths.section,
        accuracy.errors,
        accuracy.how_sure,
        accuracy.innovations,
        timeline.health,
        timeline.availability,
        timeline.deviation,
        paths.states,
        paths.space,
    )
    drawn = [figure for draw in order if (figure := draw(report, pen)) is not None]
    for figure in drawn:
        below = figure.layout.get("xaxis", {})
        if below.get("title") == {"text": TIME} and "range" not in below:
            below["range"] = list(report.span_s())
    return drawn


def _facts(report: Report) -> str:
    first = next(iter(ran(report.summaries).values()))
    options = first["options"]
    without = ", ".join(options["without"])
    outages = ", ".join(f"{sensor} {start:g}–{end:g} s" for sensor, start, end in options["outages"])
    facts = {
        "log": first["log"],
        "recorded": f"{datetime.fromtimestamp(report.t0_ns // NS, UTC):%Y-%m-%d %H:%M:%S} UTC by its stamps, "
        f"{first['duration_s']:.1f} s, {first['keyframes']} keyframes",
        "rig": first["rig"],
        "estimators": ", ".join(ran(report.summaries))
        + "".join(f"; not run: {name}" for name in not_run(report.summaries)),
        "truth": first["truth"] or "none",
        "hidden on purpose": "; ".join(filter(None, [outages, without and f"without {without}"])),
        "changed in the rig": ", ".join(options["set"]),
        "made by": f"tbmfg {__version__}",
    }
    return "<dl>" + "".join(f"<dt>{key}</dt><dd>{escape(text)}</dd>" for key, text in facts.items() if text) + "</dl>"


def _words(report: Report) -> str:
    return "".join(
        f"<div{' class=grave' if group.grave else ''}><h3>{escape(group.heading)}</h3>"
        f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in group.lines)}</ul></div>"
        for group in findings(report)
    )


def _figure(number: int, figure: Figure) -> str:
    return (
        f"<section id={_anchor(figure.title)}><h2>{escape(figure.title)}</h2>"
        f"<figure><figcaption>{escape(figure.words())}</figcaption>"
        f'<div id=figure{number} style="height:{figure.layout["height"]}px"></div></figure>{figure.table}</section>\n'
    )


def _anchor(title: str) -> str:
    """A title of ours as the name of its section."""
    return title.lower().replace(" ", "-")


def _json(drawn: list[Figure]) -> str:
    """Figures as JSON that cannot end the script element it stands in."""
    text = json.dumps([{"data": f.data, "layout": f.layout} for f in drawn], allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
