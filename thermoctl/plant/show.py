"""A plant as a picture (nodes, flows, outputs) and as a table.

The layout minimises stress, sum of (|x_i - x_j| - d_ij)^2 / d_ij^2 with d the distance in the graph, by
majorisation (Gansner, Koren, North 2004). Flows to and from the outside and outputs are small satellites of
their nodes.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant
from thermoctl.safe_file import whole_file
from thermoctl.yamlfile import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Text


Vertex = tuple[str, str, str]
Edge = tuple[int, int, str, str]


def _graph(plant: Plant) -> tuple[list[Vertex], list[Edge]]:
    """Return vertices (kind, key, label) and edges (from, to, kind, label).

    A node has one satellite for its inflows, one for its outflows and one for its readings. A reading of
    several nodes is a vertex of its own.
    """
    vertices = [("node", n.name, f"{n.name}\n[{n.unit}]" if n.unit else n.name) for n in plant.nodes.values()]
    index = {n: i for i, n in enumerate(plant.nodes)}
    edges: list[Edge] = []
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
        if not nodes:  # a static reading: draw its inputs beside it
            used = sorted(set().union(*(ex.names(plant.outputs[o].value) for o in names)) & set(plant.inputs))
            edges += [(len(vertices) + k, i, "read", "") for k in range(len(used))]
            vertices += [("in", n, n) for n in used]
    return vertices, edges


def _outline(text: Text) -> np.ndarray:
    """Return [[left, bottom], [right, top]] of a drawn text's box, in pixels."""
    patch = text.get_bbox_patch()
    assert patch is not None  # every text here is drawn with a box
    return patch.get_window_extent().get_points()


def _edge(box: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return the intersection of the line from `outside` (2,) to `inside` (2,) with the box round `inside`.

    box: [[left, bottom], [right, top]].
    """
    way = outside - inside
    room = np.where(way > 0, box[1] - inside, inside - box[0]) / np.maximum(np.abs(way), 1e-12)
    return inside + way * min(float(room.min()), 1.0)


def layout(count: int, edges: list[tuple[int, int, float]], rounds: int = 400) -> np.ndarray:
    """Return positions (count, 2) of vertices joined by edges of given lengths."""
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
    with whole_file(path) as part:
        drawing(plant).savefig(part, dpi=130, format=path.suffix[1:].lower())


def drawing(plant: Plant, marked: Collection[str] = (), widest: float = 40.0) -> Figure:
    """Return the network as a matplotlib Figure of at most `widest` inches.

    Nodes, flows and outputs named in `marked` are highlighted. A network that would be wider is compressed,
    without labels on its edges.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    vertices, edges = _graph(plant)
    x, closer = _places(vertices, edges, widest)
    span = np.maximum(np.ptp(x, axis=0), 0.5) if len(x) else np.ones(2)
    width = float(np.clip(2.0 + 1.75 * span[0], 6, min(40, widest)))
    figure = Figure(figsize=(width, float(np.clip(1.6 + 1.3 * span[1] * closer**0.5, 3.5, 32))))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.92))
    axes.set_axis_off()
    boxes = [_box(axes, at, vertex, marked) for at, vertex in zip(x, vertices, strict=True)]
    margin = 0.45
    axes.set_xlim(x[:, 0].min() - margin, x[:, 0].max() + margin)
    axes.set_ylim(x[:, 1].min() - margin, x[:, 1].max() + margin)
    figure.canvas.draw()  # computes the boxes' sizes, which the arrows need
    sizes = [axes.transData.inverted().transform(_outline(q)) for q in boxes]
    for a, b, kind, label in edges:
        _arrow(axes, _edge(sizes[a], x[a], x[b]), _edge(sizes[b], x[b], x[a]), kind)
        if label and closer > CLOSE:
            _line_words(axes, (x[a] + x[b]) / 2, label)
    _title_and_legend(figure, plant.title)
    return figure


CLOSE = 0.9  # edges have no labels below this share of the natural size
WIDE_IN = 11.0  # from this width on the legend stands beside the title
_STYLE = {  # edge, face, font size, word of the legend
    "node": ("#1b3a5c", "#dce8f5", 9.5, "stored quantity"),
    "in": ("#9c3d00", "#fde8d9", 8, "flow from outside"),
    "out": ("#4a5560", "#eceff1", 8, "flow to outside"),
    "read": ("#1d6b3a", "#e2f3e6", 8, "reading"),
}
_LINES = {"flow": ("#5a6b7b", "-"), "read": ("#1d6b3a", ":"), "uses": ("#9a86b8", "--")}


def _places(vertices: list[Vertex], edges: list[Edge], widest: float) -> tuple[np.ndarray, float]:
    """Return positions (vertices, 2) and the share to which the figure shrinks to `widest` inches."""
    satellites = {"in", "out", "read"}
    readings = Counter(b for _, b, kind, _ in edges if kind == "read")
    lengths = []
    for a, b, kind, _ in edges:
        if readings[b] > 1:
            length = 2.2
        elif kind == "flow" and {vertices[a][0], vertices[b][0]} & satellites:
            length = 0.75
        else:
            length = 0.85 if kind == "read" else 1.6
        lengths.append((a, b, length))
    x = layout(len(vertices), lengths)
    span = np.maximum(np.ptp(x, axis=0), 0.5) if len(x) else np.ones(2)
    closer = min(1.0, widest / (2.0 + 1.75 * span[0]))
    if closer < CLOSE:  # text does not shrink, so a satellite needs more room beside its node
        x = layout(len(vertices), [(a, b, q * 1.45 if q < 1.0 else q) for a, b, q in lengths])
    return x, closer


def _box(axes: Axes, at: np.ndarray, vertex: Vertex, marked: Collection[str]) -> Text:
    kind, key, label = vertex
    edge, face, size, _ = _STYLE[kind]
    if key in marked if kind == "node" else not set(label.split("\n")).isdisjoint(marked):
        edge, face = "#b3261e", "#ffdad6"
    shape = {
        "boxstyle": "round,pad=0.35" if kind == "node" else "round,pad=0.2",
        "fc": face,
        "ec": edge,
        "lw": 1.2 if kind == "node" else 0.6,
    }
    return axes.text(
        at[0], at[1], label, ha="center", va="center", fontsize=size, color=edge, zorder=3, bbox=shape
    )


def _arrow(axes: Axes, start: np.ndarray, end: np.ndarray, kind: str) -> None:
    colour, dashes = _LINES[kind]
    line = {
        "arrowstyle": "-" if kind == "read" else "-|>",
        "color": colour,
        "mutation_scale": 13,
        "shrinkA": 0,
        "shrinkB": 0,
        "lw": 1.3 if kind == "flow" else 0.8,
        "ls": dashes,
    }
    axes.annotate("", xy=(end[0], end[1]), xytext=(start[0], start[1]), arrowprops=line, zorder=1)


def _line_words(axes: Axes, at: np.ndarray, label: str) -> None:
    words = textwrap.fill(label.replace("_", "_ "), 22, break_long_words=False).replace("_ ", "_")
    box = {"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85}
    axes.text(
        at[0], at[1], words, fontsize=6.5, color="#5a6b7b", ha="center", va="center", zorder=2, bbox=box
    )


def _title_and_legend(figure: Figure, title: str) -> None:
    width = figure.get_figwidth()
    letters = width * 9.5 - (45 if width >= WIDE_IN else 0)
    figure.text(
        0.02, 0.995, textwrap.fill(title, max(int(letters), 20)), fontsize=12, weight="bold", va="top"
    )
    for k, (edge, face, _, word) in enumerate(_STYLE.values()):
        box = {"boxstyle": "round,pad=0.25", "fc": face, "ec": edge, "lw": 0.6}
        at = 1.0 - 1.215 / width * (4 - k)
        height = 0.025 if width < WIDE_IN else 0.965
        figure.text(at, height, word, fontsize=8, color=edge, va="center", bbox=box)


def table(plant: Plant) -> list[Table]:
    """Return the plant as rich tables: inputs, parameters, nodes, flows, outputs."""

    def make(title: str, heads: tuple[str, ...], rows: Iterable[tuple[object, ...]]) -> Table:
        """Return a table; floats have 6 significant digits, None is an empty cell."""
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
