"""A plant as a picture (nodes, flows, outputs) and as a table.

The layout minimises stress, sum of (|x_i - x_j| - d_ij)^2 / d_ij^2 with d the distance in the graph, by
majorisation (Gansner, Koren, North 2004). What enters from or leaves to the outside and what is read at a
node are small satellites.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.yamlfile import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text


def _graph(plant: Plant) -> tuple[list[tuple[str, str, str]], list[tuple[int, int, str, str]]]:
    """Vertices (kind, key, label) and edges (from, to, kind, label).

    One satellite for a node's inflows, one for its outflows, one for its readings; a reading of several nodes
    is a vertex of its own."""
    vertices = [("node", n.name, f"{n.name}\n[{n.unit}]" if n.unit else n.name) for n in plant.nodes.values()]
    index = {n: i for i, n in enumerate(plant.nodes)}
    edges: list[tuple[int, int, str, str]] = []
    outside: dict[tuple[str, str], list[str]] = {}
    for f in plant.flows.values():
        if f.source and f.target:
            edges.append(
                (
                    index[f.source],
                    index[f.target],
                    "flow",
                    ", ".join(sorted(ex.names(f.rate) & set(plant.parameters))),
                )
            )
        else:
            outside.setdefault(("in", f.target) if f.target else ("out", f.source or ""), []).append(f.name)
    for (way, node), flows in outside.items():
        i = len(vertices)
        vertices.append((way, node, "\n".join(flows[:4] + (["..."] if len(flows) > 4 else []))))
        edges.append((i, index[node], "flow", "") if way == "in" else (index[node], i, "flow", ""))
    for f in plant.flows.values():
        drawn = {q for q in (f.source, f.target) if q}
        others = sorted(ex.names(f.rate) & set(plant.nodes) - drawn)
        edges += [(index[n], index[end], "uses", "") for n in others for end in sorted(drawn)]
    edges = list(dict.fromkeys(edges))
    readings: dict[tuple[str, ...], list[str]] = {}
    for o in plant.outputs.values():
        readings.setdefault(tuple(sorted(ex.names(o.value) & set(plant.nodes))), []).append(o.name)
    for nodes, names in readings.items():
        i = len(vertices)
        vertices.append(("read", ",".join(nodes), "\n".join(names)))
        edges += [(index[n], i, "read", "") for n in nodes]
        if not nodes:  # a static reading: the inputs it is made of stand beside it
            used = sorted(set().union(*(ex.names(plant.outputs[o].value) for o in names)) & set(plant.inputs))
            edges += [(len(vertices) + k, i, "read", "") for k in range(len(used))]
            vertices += [("in", n, n) for n in used]
    return vertices, edges


def _outline(text: Text) -> np.ndarray:
    """[[left, bottom], [right, top]] of a drawn text's box, in pixels."""
    patch = text.get_bbox_patch()
    assert patch is not None  # every text here is drawn with a box
    return patch.get_window_extent().get_points()


def _edge(box: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return where the line from `outside` (2,) to `inside` (2,) meets the box round `inside`.

    box: [[left, bottom], [right, top]]."""
    way = outside - inside
    room = np.where(way > 0, box[1] - inside, inside - box[0]) / np.maximum(np.abs(way), 1e-12)
    return inside + way * min(float(room.min()), 1.0)


def layout(count: int, edges: list[tuple[int, int, float]], rounds: int = 400) -> np.ndarray:
    """Positions (count, 2) of vertices joined by edges of given lengths."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import shortest_path

    if count < 2:
        return np.zeros((count, 2))
    i, j, length = (
        (np.array(c) for c in zip(*edges, strict=True))
        if edges
        else (np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    )
    d = shortest_path(csr_matrix((length, (i, j)), shape=(count, count)), directed=False)
    reach = np.max(d[np.isfinite(d)], initial=1.0)
    d = np.where(np.isfinite(d), d, reach * 0.6 + 1.0)
    centred = -0.5 * (np.eye(count) - 1 / count) @ d**2 @ (np.eye(count) - 1 / count)
    values, vectors = np.linalg.eigh(centred)
    x = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 1e-3)) + np.random.default_rng(1).normal(
        0, 0.01, (count, 2)
    )
    w = 1 / np.maximum(d, 1e-9) ** 2
    np.fill_diagonal(w, 0)
    laplacian = np.linalg.pinv(np.diag(w.sum(1)) - w)
    for _ in range(rounds):
        delta = x[:, None] - x[None]
        b = -w * d / np.maximum(np.linalg.norm(delta, axis=2), 1e-9)
        np.fill_diagonal(b, 0)
        np.fill_diagonal(b, -b.sum(1))
        x = laplacian @ (b @ x)
    _, _, axes = np.linalg.svd(x - x.mean(0), full_matrices=False)
    return (x - x.mean(0)) @ axes.T


def draw(plant: Plant, path: str | Path) -> None:
    """Write the network as .svg, .png or .pdf.

    Raises InputError for another ending or a place that cannot be written."""
    path = Path(path)
    if path.suffix.lower() not in (".svg", ".png", ".pdf"):
        raise InputError(f"{path}: a name that ends in .svg, .png or .pdf was expected")
    try:
        drawing(plant).savefig(path, dpi=130)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror or e}") from None


def drawing(plant: Plant, marked: Collection[str] = (), widest: float = 40.0) -> Figure:
    """Return the network as a matplotlib Figure of at most `widest` inches.

    nodes, flows and outputs named in `marked` stand out. Where it would be wider it is drawn closer, without
    the words on its lines."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    vertices, edges = _graph(plant)
    near = {"in", "out", "read"}
    lengths = [
        (
            a,
            b,
            0.75
            if {vertices[a][0], vertices[b][0]} & near and kind == "flow"
            else 0.85
            if kind == "read"
            else 1.6,
        )
        for a, b, kind, _ in edges
    ]
    several: dict[int, int] = {}
    for _, b, kind, _ in edges:
        if kind == "read":
            several[b] = several.get(b, 0) + 1
    lengths = [(a, b, 2.2) if several.get(b, 0) > 1 else (a, b, q) for a, b, q in lengths]
    x = layout(len(vertices), lengths)
    span = np.maximum(np.ptp(x, axis=0), 0.5) if len(x) else np.ones(2)
    closer = min(1.0, widest / (2.0 + 1.75 * span[0]))
    if closer < 0.9:  # the words keep their size: what hangs on a node needs more room beside it
        x = layout(len(vertices), [(a, b, q * 1.45 if q < 1.0 else q) for a, b, q in lengths])
        span = np.ptp(x, axis=0)
    figure = Figure(
        figsize=(
            float(np.clip(2.0 + 1.75 * span[0], 6, min(40, widest))),
            float(np.clip(1.6 + 1.3 * span[1] * closer**0.5, 3.5, 32)),
        )
    )
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.92))
    axes.set_axis_off()
    style = {
        "node": ("#1b3a5c", "#dce8f5", 9.5),
        "in": ("#9c3d00", "#fde8d9", 8),
        "out": ("#4a5560", "#eceff1", 8),
        "read": ("#1d6b3a", "#e2f3e6", 8),
    }
    colours = {"flow": "#5a6b7b", "read": "#1d6b3a", "uses": "#9a86b8"}
    boxes = {}
    for i, (kind, key, label) in enumerate(vertices):
        edge, face, size = style[kind]
        if key in marked if kind == "node" else not set(label.split("\n")).isdisjoint(marked):
            edge, face = "#b3261e", "#ffdad6"
        boxes[i] = axes.text(
            x[i, 0],
            x[i, 1],
            label,
            ha="center",
            va="center",
            fontsize=size,
            color=edge,
            zorder=3,
            bbox={
                "boxstyle": "round,pad=0.35" if kind == "node" else "round,pad=0.2",
                "fc": face,
                "ec": edge,
                "lw": 1.2 if kind == "node" else 0.6,
            },
        )
    margin = 0.45
    axes.set_xlim(x[:, 0].min() - margin, x[:, 0].max() + margin)
    axes.set_ylim(x[:, 1].min() - margin, x[:, 1].max() + margin)
    figure.canvas.draw()  # gives the boxes their sizes, at which the arrows end
    sizes = {i: axes.transData.inverted().transform(_outline(q)) for i, q in boxes.items()}
    for a, b, kind, label in edges:
        line = {
            "arrowstyle": "-" if kind == "read" else "-|>",
            "color": colours[kind],
            "mutation_scale": 13,
            "shrinkA": 0,
            "shrinkB": 0,
            "lw": 1.3 if kind == "flow" else 0.8,
            "ls": {"flow": "-", "read": ":", "uses": "--"}[kind],
        }
        axes.annotate(
            "",
            xy=(*_edge(sizes[b], x[b], x[a]),),
            xytext=(*_edge(sizes[a], x[a], x[b]),),
            arrowprops=line,
            zorder=1,
        )
        if label and closer > 0.9:
            middle = (x[a] + x[b]) / 2
            broken = textwrap.fill(label.replace("_", "_ "), 22, break_long_words=False).replace("_ ", "_")
            axes.text(
                middle[0],
                middle[1],
                broken,
                fontsize=6.5,
                color="#5a6b7b",
                ha="center",
                va="center",
                zorder=2,
                bbox={"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85},
            )
    room = figure.get_figwidth() * 9.5 - (
        45 if figure.get_figwidth() >= 11 else 0
    )  # letters of the title in a line
    figure.text(
        0.02, 0.995, textwrap.fill(plant.title, max(int(room), 20)), fontsize=12, weight="bold", va="top"
    )
    words = {
        "node": "stored quantity",
        "in": "flow from outside",
        "out": "flow to outside",
        "read": "reading",
    }
    for k, (kind, word) in enumerate(words.items()):
        at = 1.0 - 1.215 / figure.get_figwidth() * (4 - k)
        figure.text(
            at,
            0.025 if figure.get_figwidth() < 11 else 0.965,
            word,
            fontsize=8,
            color=style[kind][0],
            va="center",
            bbox={"boxstyle": "round,pad=0.25", "fc": style[kind][1], "ec": style[kind][0], "lw": 0.6},
        )
    return figure


def table(plant: Plant) -> list[Table]:
    """Return the plant as rich tables: inputs, parameters, nodes, flows, outputs."""

    def make(title: str, heads: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> Table:
        made = Table(title=title, title_justify="left", title_style="bold", header_style="bold")
        for head in heads:
            right = head in ("low", "high", "noise", "step") or (head == "value" and title == "Parameters")
            made.add_column(head, justify="right" if right else "left", overflow="fold")
        for row in rows:
            made.add_row(*("" if q is None else f"{q:.6g}" if isinstance(q, float) else str(q) for q in row))
        return made

    parts = [
        make(
            "Inputs",
            ("name", "unit", "column", "between samples"),
            [(i.name, i.unit, i.column, "linear" if i.linear else "hold") for i in plant.inputs.values()],
        ),
        make(
            "Parameters",
            ("name", "value", "unit", "low", "high"),
            [(p.name, p.value, p.unit, *(p.range or (None, None))) for p in plant.parameters.values()],
        ),
        make(
            "Nodes",
            ("name", "unit", "storage", "initial"),
            [(n.name, n.unit, n.storage, n.initial) for n in plant.nodes.values()],
        ),
        make(
            "Flows",
            ("name", "from", "into", "rate", "unit"),
            [
                (f.name, f.source or "(outside)", f.target or "(outside)", f.rate, f.unit)
                for f in plant.flows.values()
            ],
        ),
        make(
            "Outputs",
            ("name", "value", "unit", "noise", "step"),
            [(o.name, o.value, o.unit, o.noise, o.resolution) for o in plant.outputs.values()],
        ),
    ]
    return [p for p in parts if p.row_count]
