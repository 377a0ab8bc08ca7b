"""Pictures: a plant with its nodes, flows and outputs, and its outputs over time.

The layout minimises stress, sum of (|x_i - x_j| - d_ij)^2 / d_ij^2 with d the distance in the graph, by
majorisation (Gansner, Koren, North 2004). Flows to and from the outside and outputs are small satellites of
their nodes.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from thermoctl.files.safe_file import whole_file
from thermoctl.files.yamlfile import InputError
from thermoctl.plant import expression as ex
from thermoctl.plant.language import Plant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    from thermoctl.plant.simulation.simulate import Excitation

Vertex = tuple[str, str, str]
Edge = tuple[int, int, str, str]


def _graph(plant: Plant) -> tuple[list[Vertex], list[Edge]]:
    """Return vertices (kind, key, label) and edges (from, to, kind, label).

    A node has one satellite for its inflows, one for its outflows and one for its readings. A reading of
    several nodes is a vertex of its own."""
    vertices = [("node", n.name, f"{n.name}\n[{n.unit}]" if n.unit else n.name) for n in plant.nodes.values()]
    index = {n: i for i, n in enumerate(plant.nodes)}
    edges: list[Edge] = []
    outside: dict[tuple[str, str], list[str]] = {}
    for f in plant.flows.values():
        if f.source and f.target:
            label = ", ".join(sorted(ex.names(f.rate) & set(plant.parameters)))
            edges.append((index[f.source], index[f.target], "flow", label))
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


def _edge(box: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return the intersection of the line from `outside` (2,) to `inside` (2,) with the box round `inside`.

    box: [[left, bottom], [right, top]]."""
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


def drawing(plant: Plant, marked: Collection[str] = (), widest: float = 40.0, title: bool = True) -> Figure:
    """Return the network as a matplotlib Figure of at most `widest` inches, as large as its texts need.

    Nodes, flows and outputs named in `marked` are highlighted. Labels of edges stand where there is room."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    vertices, edges = _graph(plant)
    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))  # its units are inches
    axes.set_axis_off()
    boxes = [_box(axes, vertex, marked) for vertex in vertices]
    inch = figure.dpi
    sizes = np.array([_size(box, canvas, inch) for box in boxes]).reshape(-1, 2)
    x = _places(vertices, edges, sizes, widest)
    for box, middle in zip(boxes, x, strict=True):
        box.set_position((middle[0], middle[1]))
    taken = [np.array([middle - q / 2, middle + q / 2]) for middle, q in zip(x, sizes, strict=True)]
    low = np.min([q[0] for q in taken], axis=0, initial=0.0) - MARGIN
    high = np.max([q[1] for q in taken], axis=0, initial=0.0) + MARGIN
    for a, b, kind, _ in edges:
        _arrow(axes, _edge(taken[a], x[a], x[b]), _edge(taken[b], x[b], x[a]), kind)
    for a, b, _, label in edges:
        if label:
            ends = _edge(taken[a], x[a], x[b]), _edge(taken[b], x[b], x[a])
            _label(axes, ends, label, taken, canvas, inch)
    low[1] -= _legend(axes, low, max(high[0], low[0] + 3.3), canvas, inch)
    if title:
        words = textwrap.fill(plant.title, max(int((high[0] - low[0]) * 9.5), 20))
        head = axes.text(low[0], high[1], words, fontsize=12, weight="bold", va="bottom", zorder=2)
        high = np.maximum(high, low + [_size(head, canvas, inch)[0], 0.0])
        high[1] += _size(head, canvas, inch)[1]
    high[0] = max(high[0], low[0] + 3.3)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    figure.set_size_inches(*(high - low))
    return figure


def over_time(figure: Figure, plant: Plant, excitation: Excitation, lines: Mapping[str, np.ndarray]) -> Any:
    """Draw the measured outputs, and simulated ones (N, outputs) by label; return the axes of each output."""
    panels = figure.subplots(len(plant.outputs), 1, sharex=True, squeeze=False)[:, 0]
    for j, (axes, o) in enumerate(zip(panels, plant.outputs.values(), strict=True)):
        seen = np.isfinite(excitation.y[:, j])
        axes.plot(excitation.t[seen], excitation.y[seen, j], ".", ms=2, color="#7a8894", label="measured")
        for (label, y), colour in zip(lines.items(), _COLOURS[-len(lines) :], strict=False):
            axes.plot(excitation.t, y[:, j], lw=1.1, color=colour, label=label)
        axes.set_ylabel(f"{o.name}\n[{o.unit or '?'}]", fontsize=8)
        axes.grid(alpha=0.3)
    panels[0].legend(loc="upper right", fontsize=8)
    panels[-1].set_xlabel("t [s]")
    return panels


_COLOURS = ("#b7791f", "#2b6cb0", "#c2410c")  # colour a line; fewer lines take the last ones
UNIT_IN = np.array([1.5, 0.85])  # inches of a unit of length, before texts push each other apart
APART_IN = 0.12  # least distance of two boxes
BARE_IN = 0.4  # least length of an edge beside its label
MARGIN = 0.08  # inches round the drawing
PUSHES, STRETCH = 300, 1.003  # rounds in which boxes that overlap push each other apart; growth in each
_STYLE = {  # edge, face, font size, word of the legend
    "node": ("#0b6bcb", "#f3f6f9", 9.5, "stored quantity"),
    "in": ("#c7621b", "#f3f6f9", 8.5, "flow from outside"),
    "out": ("#7d8894", "#f3f6f9", 8.5, "flow to outside"),
    "read": ("#1a7f37", "#f3f6f9", 8.5, "reading"),
}
_MARKED = "#b3261e"
_LINES = {"flow": ("#7d8894", "-"), "read": ("#1a7f37", ":"), "uses": ("#9a86b8", "--")}
_PAD = {True: 0.35, False: 0.2}  # padding in letters of a node's box (True) and of any other box


def _size(text: Text, canvas: FigureCanvasAgg, inch: float) -> np.ndarray:
    """Return width and height (2,) of a text with its box, in inches."""
    box = text.get_bbox_patch()
    style: Any = box.get_boxstyle() if box else None
    pad = 2 * float(text.get_fontsize()) / 72 * (style.pad if style else 0.1)
    extent = text.get_window_extent(cast(Any, canvas).get_renderer())
    return np.array([extent.width, extent.height]) / inch + pad


def _places(vertices: list[Vertex], edges: list[Edge], sizes: np.ndarray, widest: float) -> np.ndarray:
    """Return positions (vertices, 2) in inches of boxes with sizes (vertices, 2), which do not overlap."""
    satellites = {"in", "out", "read"}
    readings = Counter(b for _, b, kind, _ in edges if kind == "read")
    lengths = []
    for a, b, kind, _ in edges:
        if readings[b] > 1:
            length = 2.2
        elif kind == "flow" and {vertices[a][0], vertices[b][0]} & satellites:
            length = 1.0
        else:
            length = 1.0 if kind == "read" else 1.7
        lengths.append((a, b, length))
    x = layout(len(vertices), lengths)
    room = widest - float(sizes[:, 0].max(initial=0.0)) - 2 * MARGIN
    if len(x) and np.ptp(x[:, 0]) * UNIT_IN[0] > room > np.ptp(x[:, 1]) * UNIT_IN[0]:
        x = x[:, ::-1]  # upright
    scale = UNIT_IN.copy()
    scale[0] = min(scale[0], room / max(float(np.ptp(x[:, 0])) if len(x) else 0.0, 1e-9))
    x = x * scale
    for _ in range(PUSHES):
        way = x[:, None] - x[None]
        into = (sizes[:, None] + sizes[None]) / 2 + APART_IN - np.abs(way)
        np.fill_diagonal(into[:, :, 0], 0.0)
        depth = np.where((into > 1e-6).all(axis=2), into[:, :, 1], 0.0)
        if not depth.any():
            break
        up = np.where(way[:, :, 1] == 0, np.arange(len(x))[:, None] - np.arange(len(x)), way[:, :, 1])
        x[:, 1] = STRETCH * x[:, 1] + (0.25 * depth * np.sign(up)).sum(axis=1)
    return x


def _box(axes: Axes, vertex: Vertex, marked: Collection[str]) -> Text:
    kind, key, label = vertex
    edge, face, size, _ = _STYLE[kind]
    is_marked = key in marked if kind == "node" else not set(label.split("\n")).isdisjoint(marked)
    edge = _MARKED if is_marked else edge
    style = f"round,pad={_PAD[kind == 'node']}"
    shape = {
        "boxstyle": style,
        "fc": face,
        "ec": edge,
        "lw": 2.0 if is_marked else 1.2 if kind == "node" else 0.6,
    }
    return axes.text(0, 0, label, ha="center", va="center", fontsize=size, color=edge, zorder=3, bbox=shape)


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


def _label(
    axes: Axes,
    ends: tuple[np.ndarray, np.ndarray],
    label: str,
    taken: list[np.ndarray],
    canvas: FigureCanvasAgg,
    inch: float,
) -> None:
    """Write the label of an edge where there is room for it; its place is appended to `taken`."""
    middle, way = (ends[0] + ends[1]) / 2, np.abs(ends[1] - ends[0])
    words = textwrap.fill(label.replace("_", "_ "), 22, break_long_words=False).replace("_ ", "_")
    box = {"boxstyle": "square,pad=0.1", "fc": "#ffffff", "ec": "none"}
    text = axes.text(
        middle[0],
        middle[1],
        words,
        fontsize=7.5,
        color="#7d8894",
        ha="center",
        va="center",
        zorder=2,
        bbox=box,
    )
    half = _size(text, canvas, inch) / 2
    bare = np.linalg.norm(way) * (1 - float(np.min(2 * half / np.maximum(way, 1e-9))))
    if bare < BARE_IN or any((middle + half > q[0]).all() and (middle - half < q[1]).all() for q in taken):
        text.remove()
    else:
        taken.append(np.array([middle - half, middle + half]))


def _legend(axes: Axes, low: np.ndarray, right: float, canvas: FigureCanvasAgg, inch: float) -> float:
    """Write the kinds of boxes below the drawing, in rows up to `right`; return their height in inches."""
    left, row = float(low[0]), 0
    for edge, face, _, word in _STYLE.values():
        box = {"boxstyle": "round,pad=0.25", "fc": face, "ec": edge, "lw": 0.6}
        text = axes.text(0, 0, word, fontsize=8, color=edge, va="center", bbox=box)
        width = float(_size(text, canvas, inch)[0])
        if left + width > right and left > low[0]:
            left, row = float(low[0]), row + 1
        text.set_position((left + 0.05, float(low[1]) - 0.2 - 0.26 * row))
        left += width + 0.12
    return 0.4 + 0.26 * row
