"""Thermal truth: bodies of one-dimensional finite volumes, solved by exponential time differencing.

Every body is a rod of CELLS volumes; links, films, radiation and foreign heat act on its surface volume, Joule heat is
spread over all, the sensor reads the mean. With x the volumes' temperatures

    C dx/dt = -L x + f(x, t)            L: conduction inside and between bodies and to the air, constant
    z+ = exp(-lam h) z + phi1 F(z) ;  z+ += phi2 (F(z+) - F(z))      ETD2RK in the eigenvectors of C^-1/2 L C^-1/2

All that is not linear and constant (changed parameters, effects) is in f. Many variants (rows) go through together;
effects are arrays of numbers, zero when absent.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tests.concealed import sensors

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


@np.errstate(
    over="ignore", invalid="ignore"
)  # a rival too large for the rig runs away: its row is not finite
def simulate(net: Network, theta: dict, run: dict, rows: list[Variant]) -> np.ndarray:
    """Mean temperatures (m, N, bodies), degC, of every variant; `run`: t (s), air, heats (W), velocity, position."""
    names, flows = list(net.bodies), list(net.edges)
    nb, ne, m, cells = len(names), len(flows), len(rows), net.cells
    at = {n: i for i, n in enumerate(names)}
    c0 = np.array([theta[p] for p in net.bodies.values()])
    g0 = np.array([theta[net.edges[f][0]] for f in flows])
    a = np.array([at[net.edges[f][1]] for f in flows])
    b = np.array([at.get(net.edges[f][2], nb) for f in flows])  # nb stands for the air
    into = np.zeros((ne, nb + 1))
    into[np.arange(ne), a] -= 1
    into[np.arange(ne), b] += 1
    into = into[:, :nb]

    # the linear operator and its modes
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
        g = run.get("stiffness", net.stiffness) * max(touching[k], 1e-3) * cells
        for c in range(cells - 1):
            i = surface[k] + c
            lin[i : i + 2, i : i + 2] += g * np.array([[1, -1], [-1, 1]])
    root = np.sqrt(np.repeat(c0 / cells, cells))
    lam, vec = np.linalg.eigh(lin / np.outer(root, root))
    lam = np.maximum(lam, 1e-9)
    to_surface = (vec[surface] / root[surface, None]).T  # modes -> surface temperatures
    mean = np.zeros((nb, n))
    for k in range(nb):
        mean[k, surface[k] : surface[k] + cells] = 1 / cells
    to_mean = ((mean / root) @ vec).T
    read = np.concatenate([to_surface, to_mean], axis=1)
    from_force = np.concatenate([to_surface.T, to_mean.T], axis=0)  # W at the surfaces, W spread over bodies

    v = _Arrays(net, theta, rows, names, flows, run)
    t, air = run["t"], run["air"]
    h = np.diff(t)
    x0 = np.full((m, nb), air[0]) + run.get("start", np.zeros(nb)) + v.start
    z = (np.repeat(x0, cells, axis=1) * root) @ vec
    hidden = np.where(v.hid_air > 0, air[0], x0)
    out = np.empty((m, len(t), nb))
    heat_total = [np.asarray(run[name], float) for name in v.heat_columns]

    def force(
        z: np.ndarray, hidden: np.ndarray, k: int, air_now: float, now: float
    ) -> tuple[np.ndarray, np.ndarray]:
        temps = z @ read
        ts, tm = temps[:, :nb], temps[:, nb:]
        other = np.concatenate([ts, np.full((m, 1), air_now)], axis=1)[:, b]
        drop = ts[:, a] - other
        g = v.g if not v.g_varies else v.conductance(ts[:, a], k, now)
        flux = g * drop
        linear = g0 * (ts[:, a] - np.where(b < nb, other, 0.0))
        net_w = flux @ into
        surface_w = (flux - linear) @ into
        extra, heat, hidden_rate = v.extra(ts, tm, hidden, k, air_now, now, heat_total)
        surface_w = surface_w + extra
        volume_w = heat
        if v.c_varies:
            volume_w = volume_w + (c0 / v.capacity(tm) - 1) * (net_w + extra + heat)
        return np.concatenate([surface_w, volume_w], axis=1) @ from_force, hidden_rate

    for k in range(len(t)):
        out[:, k] = z @ to_mean
        if k == len(h):
            break
        e = np.exp(-lam * h[k])
        phi1 = -np.expm1(-lam * h[k]) / lam
        phi2 = np.where(lam * h[k] > 1e-4, (1 - phi1 / h[k]) / lam, h[k] / 2)
        f0, d0 = force(z, hidden, k, air[k], t[k] - t[0])
        z1 = z * e + phi1 * f0
        h1 = hidden + h[k] * d0
        f1, d1 = force(z1, h1, k, air[k + 1], t[k + 1] - t[0] - 1e-9)
        z = z1 + phi2 * (f1 - f0)
        hidden = hidden + h[k] / 2 * (d0 + d1)
    return out


class _Arrays:
    """The variants of a batch as arrays (m, bodies) and (m, flows)."""

    def __init__(
        self, net: Network, theta: dict, rows: list[Variant], names: list[str], flows: list[str], run: dict
    ):
        m, nb, ne = len(rows), len(names), len(flows)
        self.names, self.run = names, run
        at = {n: i for i, n in enumerate(names)}
        full = [{**theta, **r.theta} for r in rows]
        self.g = np.array([[p[net.edges[f][0]] for f in flows] for p in full])
        self.c = np.array([[p[c] for c in net.bodies.values()] for p in full])
        self.start = np.array([[r.start.get(n, 0.0) for n in names] for r in rows])
        body = {
            k: np.zeros((m, nb))
            for k in ("rad", "nat", "q", "eddy", "hyst", "cap", "base", "hid_g", "hid_air", "melt", "burst")
        }
        edge = {k: np.zeros((m, ne)) for k in ("temp", "pos", "step", "fan", "fatigue")}
        edge["forced"] = np.zeros((m, ne))
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
        self.body = {k: x for k, x in body.items() if np.any(x)}
        self.hid_g, self.hid_air = body["hid_g"], body["hid_air"]
        self.edge = {k: x for k, x in edge.items() if np.any(x)}
        self.g_varies = bool(self.edge)
        self.fan_on = np.zeros((m, ne))
        self.cap, self.melt = body["cap"], body["melt"]
        c_truth = np.array([theta[c] for c in net.bodies.values()])
        self.c_varies = bool(np.any(self.cap) or np.any(self.melt) or np.any(self.c != c_truth))
        self.heat_columns = [f"heat:{q}" for q in heats]
        self.heat_body = np.array([at[net.joule[q][0]] for q in heats])
        self.split_any = bool(np.any(self.split))
        self.heat_scale = np.array([[p.get(f"scale:{q}", 1.0) for q in heats] for p in full])
        self.to_air = np.array([net.edges[f][2] == "air" for f in flows])

    def conductance(self, source: np.ndarray, k: int, now: float) -> np.ndarray:
        """Conductances (m, flows), W/K."""
        g = self.g
        if "temp" in self.edge:
            g = g * np.maximum(1 + self.edge["temp"] * (source - 20), 0.05)
        if "step" in self.edge:
            g = g * (1 + self.edge["step"] * (now >= self.t0))
        if "forced" in self.edge:
            g = g * (1 + self.edge["forced"] * abs(self.run["velocity"][k]) ** 0.5)
        if "pos" in self.edge:
            g = g * (1 + self.edge["pos"] * self.run["position"][k])
        if "fan" in self.edge:
            excess = source - self.run["air"][k]
            self.fan_on = np.where(excess > 8, 1.0, np.where(excess < 5, 0.0, self.fan_on))
            g = g * (1 + self.edge["fan"] * self.fan_on)
        return g

    def capacity(self, tm: np.ndarray) -> np.ndarray:
        """Storages (m, bodies), J/K."""
        c = self.c * np.maximum(1 + self.cap * (tm - 20), 0.1)
        if np.any(self.melt):
            c = c * (1 + self.melt * np.exp(-0.5 * ((tm - self.run["melt_at"]) / 1.0) ** 2))
        return c

    def extra(self, ts, tm, hidden, k, air, now, heats):
        """Foreign heat at the surfaces, Joule heat in the volumes (m, bodies) W, and the hidden masses' rates K/s."""
        w = np.zeros_like(ts)
        b = self.body
        rise = ts - air
        if "rad" in b:
            w -= b["rad"] * ((ts + KELVIN) ** 4 - (air + KELVIN) ** 4)
        if "nat" in b:
            w -= b["nat"] * rise * np.abs(rise) ** 0.25
        if "q" in b:
            w += b["q"] * ((now >= self.t0) & (now < self.t1))
        if "eddy" in b:
            w += b["eddy"] * self.run["velocity"][k] ** 2
        if "hyst" in b:
            w += b["hyst"] * abs(self.run["velocity"][k])
        if "base" in b:
            w -= b["base"] * (ts - self.run["base"][k])
        if "burst" in b:
            w -= b["burst"] * np.maximum(rise - 4, 0) * (now % 240 < 40)
        for r, i, j, g in self.links:
            w[r, i] -= g * (ts[r, i] - ts[r, j])
            w[r, j] += g * (ts[r, i] - ts[r, j])
        flow = self.hid_g * (ts - hidden)
        w -= flow
        rate = (flow - self.hid_air * (hidden - air)) / self.hid_c
        heat = np.zeros_like(ts)
        for q, (body, column) in enumerate(zip(self.heat_body, heats, strict=True)):
            watts = column[k] * self.heat_scale[:, q] * (1 + self.copper[:, q] * (tm[:, body] - 20))
            heat[:, body] += watts
            if self.split_any:
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
