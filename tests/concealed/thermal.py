"""Thermal truth: bodies of one-dimensional finite volumes, solved by exponential time differencing.

Every body is a rod of CELLS volumes; links, films, radiation and foreign heat act on its surface volume, Joule heat is
spread over all, the sensor reads the mean. With x the volumes' temperatures

    C dx/dt = -L x + f(x, t)            L: conduction inside and between bodies and to the air, constant
    z+ = exp(-lam h) z + phi1 F(z) ;  z+ += phi2 (F(z+) - F(z))      ETD2RK in the eigenvectors of C^-1/2 L C^-1/2

All that is not linear and constant (changed parameters, effects) is in f. Many variants (rows) go through together;
effects are arrays of numbers, zero when absent. The loop over samples is compiled (loops.pyx); march_in_python is the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.concealed import sensors
from tests.concealed.compiled import loops

KELVIN = 273.15


@dataclass
class Variant:
    """One row of a batch: parameter values that differ from the truth's, start offsets and effects."""

    theta: dict[str, float] = field(default_factory=dict)
    start: dict[str, float] = field(default_factory=dict)
    effects: list[tuple[str, str, dict]] = field(default_factory=list)


@dataclass(frozen=True)
class Network:
    """Bodies and flows as the plant file names them: bodies {node: storage}, edges {flow: (conductance, node, node or
    "air")}, joule {flow: (node, kind)} with kind "power" (an input column of watts), "vi" or "i2r"."""

    bodies: dict[str, str]
    edges: dict[str, tuple[str, str, str]]
    joule: dict[str, tuple[str, str]]
    cells: int = 6
    stiffness: float = 150.0


def simulate(net: Network, theta: dict, run: dict, rows: list[Variant]) -> np.ndarray:
    """Mean temperatures (m, N, bodies), degC, of every variant; `run`: t (s), air, heats (W), velocity, position."""
    heat = [_thermal(net, row) for row in rows]
    apart = [r for r, row in enumerate(heat) if row not in heat[:r]]  # a faulty sensor changes no temperature
    modes = _modes(net, theta | rows[0].theta, run)  # the others differ little from the first
    found = march(modes, Rows(net, theta, [heat[r] for r in apart], run), run)
    return found[[next(i for i, r in enumerate(apart) if heat[r] == row) for row in heat]]


def _thermal(net: Network, row: Variant) -> Variant:
    """The part of a variant that the temperatures depend on."""
    own = {*net.bodies.values(), *(g for g, _, _ in net.edges.values())}
    return Variant(
        {p: v for p, v in row.theta.items() if p in own or p.startswith("scale:")},
        row.start,
        [e for e in row.effects if e[0] not in sensors.SENSOR_FAULTS and e[0] not in OUTPUT_EFFECTS],
    )


def march_compiled(modes: Modes, v: Rows, run: dict) -> np.ndarray:
    """All rows (m, N, bodies) through the compiled loop."""
    out = np.empty((len(v.g), len(run["t"]), len(modes.c0)))
    loops.thermal(modes, v, run, out)
    return out


@np.errstate(
    over="ignore", invalid="ignore"
)  # a rival too large for the rig runs away: its row is not finite
def march_in_python(modes: Modes, v: Rows, run: dict) -> np.ndarray:
    """The same as march_compiled: what it is compared with, and what tells how it goes."""
    nb, m, a, b = len(modes.c0), len(v.g), modes.a, modes.b
    t, air = run["t"], run["air"]
    h = np.diff(t)
    z, hidden = modes.start(v, run), modes.hidden_start(v, run)
    out = np.empty((m, len(t), nb))
    heat_total = [np.asarray(run[name], float) for name in v.heat_columns]
    c_varies = v.present & {"cap", "melt"} or np.any(v.c != modes.c0)

    def force(
        z: np.ndarray, hidden: np.ndarray, k: int, air_now: float, now: float
    ) -> tuple[np.ndarray, np.ndarray]:
        temps = z @ modes.read
        ts, tm = temps[:, :nb], temps[:, nb:]
        other = np.concatenate([ts, np.full((m, 1), air_now)], axis=1)[:, b]
        drop = ts[:, a] - other
        g = v.g if not v.g_varies else v.conductance(ts[:, a], k, now)
        flux = g * drop
        linear = modes.g0 * (ts[:, a] - np.where(b < nb, other, 0.0))
        net_w = flux @ modes.into
        surface_w = (flux - linear) @ modes.into
        extra, heat, hidden_rate = v.extra(ts, tm, hidden, k, air_now, now, heat_total)
        surface_w = surface_w + extra
        volume_w = heat
        if c_varies:
            volume_w = volume_w + (modes.c0 / v.capacity(tm) - 1) * (net_w + extra + heat)
        return np.concatenate([surface_w, volume_w], axis=1) @ modes.push, hidden_rate

    for k in range(len(t)):
        out[:, k] = z @ modes.read[:, nb:]
        if k == len(h):
            break
        f0, d0 = force(z, hidden, k, air[k], t[k] - t[0])
        z1 = z * modes.decay[k] + modes.phi1[k] * f0
        h1 = hidden + h[k] * d0
        f1, d1 = force(z1, h1, k, air[k + 1], t[k + 1] - t[0] - 1e-9)
        z = z1 + modes.phi2[k] * (f1 - f0)
        hidden = hidden + h[k] / 2 * (d0 + d1)
    return out


march = march_compiled


class Modes:
    """The linear operator of a network and its modes.

    `rate` (n,) 1/s; `read` (n, 2 bodies): modes to the temperatures of surfaces, then to means; `push` (2 bodies, n): W at
    the surfaces, then spread over the bodies, to modes; `decay`, `phi1`, `phi2` (N-1, n): each sample's step."""

    def __init__(self, net: Network, c0: np.ndarray, g0: np.ndarray, stiffness: float, t: np.ndarray):
        names, flows = list(net.bodies), list(net.edges)
        nb, ne, cells = len(names), len(flows), net.cells
        at = {n: i for i, n in enumerate(names)}
        self.c0, self.g0 = c0, g0
        self.a = a = np.array([at[net.edges[f][1]] for f in flows])
        self.b = b = np.array([at.get(net.edges[f][2], nb) for f in flows])  # nb stands for the air
        self.into = np.zeros((ne, nb + 1))
        self.into[np.arange(ne), a] -= 1
        self.into[np.arange(ne), b] += 1
        self.into = self.into[:, :nb]
        n = nb * cells
        lin = np.zeros((n, n))
        surface = np.arange(nb) * cells
        for e in range(ne):
            i = surface[a[e]]
            lin[i, i] += g0[e]
            if b[e] < nb:
                j = surface[b[e]]
                lin[j, j] += g0[e]
                lin[i, j] -= g0[e]
                lin[j, i] -= g0[e]
        touching = np.array([g0[(a == k) | (b == k)].sum() for k in range(nb)])
        for k in range(nb):
            g = stiffness * max(touching[k], 1e-3) * cells
            for c in range(cells - 1):
                i = surface[k] + c
                lin[i : i + 2, i : i + 2] += g * np.array([[1, -1], [-1, 1]])
        self.root = root = np.sqrt(np.repeat(c0 / cells, cells))
        lam, self.vec = np.linalg.eigh(lin / np.outer(root, root))
        self.rate = lam = np.maximum(lam, 1e-9)
        to_surface = (self.vec[surface] / root[surface, None]).T
        mean = np.zeros((nb, n))
        for k in range(nb):
            mean[k, surface[k] : surface[k] + cells] = 1 / cells
        to_mean = ((mean / root) @ self.vec).T
        self.read = np.concatenate([to_surface, to_mean], axis=1)
        self.push = np.ascontiguousarray(self.read.T)
        h = np.diff(t)[:, None]
        self.decay = np.exp(-lam * h)
        self.phi1 = -np.expm1(-lam * h) / lam
        self.phi2 = np.where(lam * h > 1e-4, (1 - self.phi1 / h) / lam, h / 2)
        self.cells = cells

    def start(self, v: Rows, run: dict) -> np.ndarray:
        """The modes (m, n) at the beginning."""
        return (np.repeat(v.at_start(run), self.cells, axis=1) * self.root) @ self.vec

    def hidden_start(self, v: Rows, run: dict) -> np.ndarray:
        """The hidden masses (m, bodies) at the beginning, degC: as their body, or as the air if they touch it."""
        return np.where(v.body["hid_air"] > 0, run["air"][0], v.at_start(run))


_kept: dict[tuple, Modes] = {}  # of the rig at hand: its two runs, in truth and as recorded


def _modes(net: Network, theta: dict, run: dict) -> Modes:
    c0 = np.array([theta[p] for p in net.bodies.values()], float)
    g0 = np.array([theta[g] for g, _, _ in net.edges.values()], float)
    stiffness = run.get("stiffness", net.stiffness)
    wiring = (tuple(net.bodies), tuple(net.edges.values()), net.cells)
    key = (*wiring, stiffness, c0.tobytes(), g0.tobytes(), run["t"].tobytes())
    if key not in _kept:
        while len(_kept) > 3:
            del _kept[next(iter(_kept))]
        _kept[key] = Modes(net, c0, g0, stiffness, run["t"])
    return _kept[key]


class Rows:
    """The variants of a batch as arrays (m, bodies) and (m, flows)."""

    def __init__(self, net: Network, theta: dict, rows: list[Variant], run: dict):
        names, flows = list(net.bodies), list(net.edges)
        m, nb, ne = len(rows), len(names), len(flows)
        self.run = run
        at = {n: i for i, n in enumerate(names)}
        full = [{**theta, **r.theta} for r in rows]
        self.g = np.array([[p[net.edges[f][0]] for f in flows] for p in full], float)
        self.c = np.array([[p[c] for c in net.bodies.values()] for p in full], float)
        self.start = np.array([[r.start.get(n, 0.0) for n in names] for r in rows])
        body = {
            k: np.zeros((m, nb))
            for k in ("rad", "nat", "q", "eddy", "hyst", "cap", "base", "hid_g", "hid_air", "melt", "burst")
        }
        edge = {k: np.zeros((m, ne)) for k in ("temp", "pos", "step", "fan", "forced")}
        self.hid_c = np.ones((m, nb))
        self.t0, self.t1 = np.zeros((m, 1)), np.full((m, 1), 1e12)
        self.split = np.zeros((m, len(net.joule), nb))
        self.copper = np.zeros((m, len(net.joule)))
        self.links: list[tuple[int, int, int, float]] = []
        heats = list(net.joule)
        for r, row in enumerate(rows):
            for effect, where, p in row.effects:
                i = at.get(where, -1)
                j = flows.index(where) if where in flows else -1
                if effect == "radiation":
                    body["rad"][r, i] = p["E"]
                elif effect == "natural_convection":
                    body["nat"][r, i] = p["G"]
                elif effect == "external_heat_source":
                    body["q"][r, i], self.t0[r], self.t1[r] = p["Q"], p["T0"], p["T1"]
                elif effect == "eddy_heating":
                    body["eddy"][r, i] = p["K"]
                elif effect == "hysteresis_heating":
                    body["hyst"][r, i] = p["K"]
                elif effect == "variable_heat_capacity":
                    body["cap"][r, i] = p["A"]
                elif effect == "second_ambient":
                    body["base"][r, i] = p["G"]
                elif effect == "hidden_thermal_mass":
                    body["hid_g"][r, i], self.hid_c[r, i], body["hid_air"][r, i] = (
                        p["G"],
                        p["C"],
                        p.get("G_air", 0.0),
                    )
                elif effect == "missing_link":
                    self.links.append((r, *(at[n] for n in where.split("-")), p["G"]))
                elif effect == "heat_split":
                    first, second = (at[n] for n in where.split("-"))
                    self.split[r, [net.joule[q][0] for q in heats].index(names[first]), second] = p["A"]
                elif effect == "copper_resistance":
                    self.copper[r, heats.index(where)] = 0.00393
                elif effect == "temperature_dependent_conductance":
                    edge["temp"][r, j] = p["A"]
                elif effect == "position_dependent_conductance":
                    edge["pos"][r, j] = p["A"]
                elif effect == "conductance_step":
                    edge["step"][r, j], self.t0[r] = p["A"], p["T0"]
                elif effect == "forced_convection":
                    edge["forced"][r, j] = p["A"]
                elif effect == "?melting":  # latent heat round 38 degC
                    body["melt"][r, i] = p["A"]
                elif effect == "?fan":  # conductance jumps at 8 K of excess, with hysteresis
                    edge["fan"][r, j] = p["A"]
                elif effect == "?boiling":  # bursts of loss, every 240 s for 40 s, when warm
                    body["burst"][r, i] = p["A"]
                elif effect in sensors.SENSOR_FAULTS or effect in OUTPUT_EFFECTS:
                    pass
                else:
                    raise KeyError(effect)
        self.body, self.edge = body, edge
        self.present = {k for k, x in (body | edge).items() if np.any(x)}
        self.g_varies = bool(self.present & set(edge))
        self.fan_on = np.zeros((m, ne))
        self.heat_columns = [f"heat:{q}" for q in heats]
        self.heat_body = np.array([at[net.joule[q][0]] for q in heats])
        self.heat_scale = np.array([[p.get(f"scale:{q}", 1.0) for q in heats] for p in full], float)

    def at_start(self, run: dict) -> np.ndarray:
        """Temperatures (m, bodies) at the beginning, degC."""
        return np.full(self.start.shape, run["air"][0]) + run.get("start", 0.0) + self.start

    def needed(self, modes: Modes) -> np.ndarray:
        """The temperatures (m, 2 bodies: surfaces, then means) on which a row's forces depend, as 0 and 1."""
        need = np.zeros((len(self.g), 2 * len(modes.c0)), np.uint8)
        surface, mean = np.split(need, 2, axis=1)  # views
        resized = (self.c != modes.c0) | (self.body["cap"] != 0) | (self.body["melt"] != 0)
        mean |= resized
        for q, body in enumerate(self.heat_body):
            mean[:, body] |= self.copper[:, q] != 0
        for k in set(self.body) - {"cap", "melt"}:
            surface |= self.body[k] != 0
        varied = self.g != modes.g0
        for x in self.edge.values():
            varied = varied | (x != 0)
        for e, (a, b) in enumerate(zip(modes.a, modes.b, strict=True)):
            inside = [i for i in (a, b) if i < len(modes.c0)]
            near = varied[:, e] | resized[:, inside].any(axis=1)  # a resized body's whole inflow counts
            for i in inside:
                surface[:, i] |= near
        for r, i, j, _ in self.links:
            surface[r, [i, j]] = 1
        surface |= resized
        return need

    def conductance(self, source: np.ndarray, k: int, now: float) -> np.ndarray:
        """Conductances (m, flows), W/K."""
        g = self.g
        if "temp" in self.present:
            g = g * np.maximum(1 + self.edge["temp"] * (source - 20), 0.05)
        if "step" in self.present:
            g = g * (1 + self.edge["step"] * (now >= self.t0))
        if "forced" in self.present:
            g = g * (1 + self.edge["forced"] * abs(self.run["velocity"][k]) ** 0.5)
        if "pos" in self.present:
            g = g * (1 + self.edge["pos"] * self.run["position"][k])
        if "fan" in self.present:
            excess = source - self.run["air"][k]
            self.fan_on = np.where(excess > 8, 1.0, np.where(excess < 5, 0.0, self.fan_on))
            g = g * (1 + self.edge["fan"] * self.fan_on)
        return g

    def capacity(self, tm: np.ndarray) -> np.ndarray:
        """Storages (m, bodies), J/K."""
        c = self.c * np.maximum(1 + self.body["cap"] * (tm - 20), 0.1)
        if "melt" in self.present:
            c = c * (1 + self.body["melt"] * np.exp(-0.5 * ((tm - self.run["melt_at"]) / 1.0) ** 2))
        return c

    def extra(self, ts, tm, hidden, k, air, now, heats):
        """Foreign heat at the surfaces, Joule heat in the volumes (m, bodies) W, and the hidden masses' rates K/s."""
        w = np.zeros_like(ts)
        b = self.body
        rise = ts - air
        if "rad" in self.present:
            w -= b["rad"] * ((ts + KELVIN) ** 4 - (air + KELVIN) ** 4)
        if "nat" in self.present:
            w -= b["nat"] * rise * np.abs(rise) ** 0.25
        if "q" in self.present:
            w += b["q"] * ((now >= self.t0) & (now < self.t1))
        if "eddy" in self.present:
            w += b["eddy"] * self.run["velocity"][k] ** 2
        if "hyst" in self.present:
            w += b["hyst"] * abs(self.run["velocity"][k])
        if "base" in self.present:
            w -= b["base"] * (ts - self.run["base"][k])
        if "burst" in self.present:
            w -= b["burst"] * np.maximum(rise - 4, 0) * (now % 240 < 40)
        for r, i, j, g in self.links:
            w[r, i] -= g * (ts[r, i] - ts[r, j])
            w[r, j] += g * (ts[r, i] - ts[r, j])
        flow = b["hid_g"] * (ts - hidden)
        w -= flow
        rate = (flow - b["hid_air"] * (hidden - air)) / self.hid_c
        heat = np.zeros_like(ts)
        for q, (body, column) in enumerate(zip(self.heat_body, heats, strict=True)):
            watts = column[k] * self.heat_scale[:, q] * (1 + self.copper[:, q] * (tm[:, body] - 20))
            heat[:, body] += watts
            if np.any(self.split):
                share = self.split[:, q] * watts[:, None]
                heat += share
                heat[:, body] -= share.sum(axis=1)
        return w, heat, rate


OUTPUT_EFFECTS = (
    "missing_member",
    "quadratic_expansion",
    "bending",
    "scale_expansion",
    "expansion_lag",
    "resistance_temperature",
    "back_emf",
    "inductance",
    "?output_memory",
)
