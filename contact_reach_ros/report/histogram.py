"""Histograms of a report, as plotly figures."""

from __future__ import annotations

from typing import Any

import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.report.curves import Chart, packed
from contact_reach_ros.timing import PERCENTILES

_BARS = 60


def histogram(values: Array, title: str, colour: str) -> Chart:
    """A chart of how often the values come, in µs; the title is that of its x axis."""
    values = values[np.isfinite(values)]
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": title}},
        "yaxis": {"title": {"text": "number of ticks"}, "type": "log", "dtick": 1, "exponentformat": "none"},
        "bargap": 0.03,
    }
    if not len(values):
        return {"data": [], "layout": layout, "missing": "not recorded in this bag"}
    # All but the farthest thousandth side by side; those beyond share the outermost bars.
    low, high = np.percentile(values, (0.1, 99.9))
    margin = 0.1 * max(high - low, 1.0)
    edges = np.linspace(low - margin, high + margin, _BARS + 1)
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    centres = 0.5 * (edges[1:] + edges[:-1])
    data = [
        {
            "type": "bar",
            "x": packed(centres),
            "y": counts.tolist(),
            "marker": {"color": colour},
            "hovertemplate": "%{y} ticks near %{x:.0f} µs<extra></extra>",
            "showlegend": False,
        }
    ]
    shares = {name: float(np.percentile(values, PERCENTILES[name])) for name in ("p50", "p99", "p999")}
    words = ", ".join(f"p{PERCENTILES[name]:g} {round(value)}" for name, value in shares.items())
    note = f"{words}, least {values.min():.0f}, most {values.max():.0f} µs; values farther out are in the outer bars"
    return {"data": data, "layout": layout, "note": note}
