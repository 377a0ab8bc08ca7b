"""Plant simulation against its peers, in one run, on the 12-node actuator: CPU times and their ratios, as a table for the docs.

    python tests/bench/plant.py [--samples 14400] [--peer-samples 720]

The peers get the same equations, inputs and tolerance. The slow ones are timed on --peer-samples and scaled to --samples (their
cost is proportional to them), because whole runs would take many minutes; what is scaled is said in the output. SciPy's finite
differences are run for every parameter on those samples, not reckoned from one run.
numba: the same expressions written as numba functions, their slopes among them, in the same method (ESDIRK4(3), steps controlled
by the same norm, sensitivities staggered, inputs interpolated) with numba's own LAPACK for the dense matrices.
"""

import argparse
import dataclasses
import time

import numpy as np
from scipy.integrate import solve_ivp

from thermoctl.identify.linearise import thermal
from thermoctl.plant import load
from thermoctl.plant.simulation.simulate import compile_plant
from thermoctl.recording.table import Table

RTOL = 1e-7


def cpu(work, rounds):
    """Smallest CPU seconds of `rounds` calls."""
    best = np.inf
    for _ in range(rounds):
        begin = time.process_time()
        result = work()
        best = min(best, time.process_time() - begin)
    return best, result


def course(n):
    t = np.arange(n, dtype=float)
    current = 0.8 * np.interp(t % 75, [0, 15, 37, 52, 75], [0, 1, 1, 0, 0])
    return Table(
        "bench",
        "bench",
        t,
        {"voltage_v": 5 * current, "current_a": current, "air_c": 22 + 0.5 * np.sin(t / 1200)},
    )


def scipy_run(heat, table):
    """The linear network in hand-written numpy, LSODA, steps no longer than the samples."""
    power, air = table.columns["voltage_v"] * table.columns["current_a"], table.columns["air_c"]
    A, b, film = heat.A, heat.b, -heat.A.sum(axis=1)
    n = len(table.t)

    def slopes(t, x):
        k = min(int(t), n - 2)
        return A @ x + b * power[k] + film * (air[k] + (t - k) * (air[k + 1] - air[k]))

    return solve_ivp(
        slopes,
        (0, table.t[-1]),
        np.full(12, air[0]),
        "LSODA",
        t_eval=table.t,
        rtol=RTOL,
        atol=RTOL,
        max_step=1.0,
    ).y.T


def scipy_differences(plant, table):
    """d states / d parameters by a run with each parameter moved by its own 1e-4."""
    out = []
    base = scipy_run(thermal(plant), table)
    for p in plant.parameters.values():
        if p.range:
            moved = dataclasses.replace(
                plant,
                parameters=plant.parameters | {p.name: dataclasses.replace(p, value=p.value * (1 + 1e-4))},
            )
            out.append((scipy_run(thermal(moved), table) - base) / (1e-4 * p.value))
    return np.array(out)


def numba_functions(plant, table):
    """(states, states and sensitivities) of the plant as numba code; raises ImportError without numba."""
    import numba

    from thermoctl.plant import expression as ex

    active = [p.name for p in plant.parameters.values() if p.range]
    nodes, inputs = list(plant.nodes), list(plant.inputs)
    net = {n: ex.ZERO for n in nodes}
    for f in plant.flows.values():
        for end, sign in ((f.source, -1.0), (f.target, 1.0)):
            if end:
                net[end] = ex.add(net[end], ex.mul(ex.num(sign), f.rate))
    slopes = [ex.div(net[n], plant.nodes[n].storage) for n in nodes]
    place = {n: f"x[{i}]" for i, n in enumerate(nodes)} | {n: f"u[{i}]" for i, n in enumerate(inputs)}
    place |= {n: f"p[{i}]" for i, n in enumerate(plant.parameters)}

    def text(e):
        a = [text(q) for q in e.args]
        if e.op in ("num", "name"):
            return f"({e.value!r})" if e.op == "num" else place[e.value]
        return f"(-{a[0]})" if e.op == "neg" else f"({f' {e.op} '.join(a)})"

    def compiled(name, entries):
        body = "".join(f"    out[{index}] = {text(e)}\n" for index, e in entries if e is not ex.ZERO)
        space = {}
        exec(f"def {name}(x, u, p, out):\n{body}", space)
        return numba.njit(space[name])

    rhs = compiled("rhs", [(str(i), e) for i, e in enumerate(slopes)])
    jac = compiled(
        "jac", [(f"{i}, {k}", ex.derivative(e, n)) for i, e in enumerate(slopes) for k, n in enumerate(nodes)]
    )
    par = compiled(
        "par",
        [(f"{i}, {c}", ex.derivative(e, q)) for i, e in enumerate(slopes) for c, q in enumerate(active)],
    )
    A = np.array(
        [
            [0, 0, 0, 0, 0, 0],
            [0.25, 0.25, 0, 0, 0, 0],
            [8611 / 62500, -1743 / 31250, 0.25, 0, 0, 0],
            [5012029 / 34652500, -654441 / 2922500, 174375 / 388108, 0.25, 0, 0],
            [
                15267082809 / 155376265600,
                -71443401 / 120774400,
                730878875 / 902184768,
                2285395 / 8070912,
                0.25,
                0,
            ],
            [82889 / 524892, 0, 15625 / 83664, 69875 / 102672, -2260 / 8211, 0.25],
        ]
    )
    hat = np.array(
        [
            4586570599 / 29645900160,
            0,
            178811875 / 945068544,
            814220225 / 1159782912,
            -3700637 / 11593932,
            61727 / 225920,
        ]
    )
    C, n, nq, nu = A.sum(1), len(nodes), len(active), len(inputs)

    @numba.njit
    def integrate(t, U, linear, p, x0, atol, rtol, sensitivities):
        x, S = x0.copy(), np.zeros((n, nq))
        X, SX = np.empty((len(t), n)), np.empty((len(t) if sensitivities else 1, n, nq))
        X[0], SX[0] = x, S
        k, stages, KS = np.zeros((6, n)), np.zeros((6, n)), np.zeros((6, n, nq))
        J, V, u, eye = np.zeros((n, n)), np.zeros((n, nq)), np.empty(nu), np.eye(n)
        f, want = np.empty(n), 0.0
        for m in range(len(t) - 1):
            at, dt = t[m], t[m + 1] - t[m]
            while at < t[m + 1]:
                left = t[m + 1] - at
                h = left if want <= 0 or want >= 0.999 * left else want
                inverse = eye
                for s in range(6):
                    part = (at + C[s] * h - t[m]) / dt
                    for q in range(nu):
                        u[q] = U[m, q] + part * (U[m + 1, q] - U[m, q]) * linear[q]
                    base = x.copy()
                    for q in range(s):
                        base += h * A[s, q] * k[q]
                    stages[s] = x if s == 0 else stages[s - 1]
                    if s == 0:
                        rhs(x, u, p, f)
                        k[0] = f
                        continue
                    if s == 1:  # the network is linear: one matrix a step
                        jac(x, u, p, J)
                        inverse = np.linalg.inv(eye - 0.25 * h * J)
                    rhs(stages[s], u, p, f)
                    stages[s] += inverse @ (base + 0.25 * h * f - stages[s])
                    k[s] = (stages[s] - base) / (0.25 * h)
                error = 0.0
                for i in range(n):
                    e = 0.0
                    for q in range(6):
                        e += h * (A[5, q] - hat[q]) * k[q, i]
                    error = max(error, abs(e) / (atol + rtol * 1e-3 * abs(x[i])))
                if error > 1:
                    want = h * max(0.1, 0.9 * error**-0.25)
                    continue
                if sensitivities:
                    for s in range(6):
                        part = (at + C[s] * h - t[m]) / dt
                        for q in range(nu):
                            u[q] = U[m, q] + part * (U[m + 1, q] - U[m, q]) * linear[q]
                        par(stages[s], u, p, V)
                        if s == 0:
                            KS[0] = J @ S + V
                            continue
                        R = S.copy()
                        for q in range(s):
                            R += h * A[s, q] * KS[q]
                        new = inverse @ (R + 0.25 * h * V)
                        KS[s] = (new - R) / (0.25 * h)
                    S = new
                x = stages[5].copy()
                grow = h * min(4.0, 0.9 * max(error, 1e-6) ** -0.25)
                want = grow if h < left else max(want, grow)
                at = t[m + 1] if h >= left else at + h
            X[m + 1] = x
            if sensitivities:
                SX[m + 1] = S
        return X, SX

    t = table.t
    U = np.column_stack([table.columns[i.column] for i in plant.inputs.values()])
    linear = np.array([float(i.linear) for i in plant.inputs.values()])
    p = np.array([q.value for q in plant.parameters.values()])
    x0, atol = np.full(n, table.columns["air_c"][0]), RTOL * 10.0

    def run(sensitivities, count=None):
        return integrate(t[:count], U[:count], linear, p, x0, atol, RTOL, sensitivities)

    begin = time.perf_counter()
    run(True, 3)
    return lambda: run(False)[0], lambda: run(True), time.perf_counter() - begin


def casadi_functions(plant, table):
    """CVODES over the samples: the states, and the states with all their sensitivities as further equations."""
    import casadi as ca

    from thermoctl.plant import expression as ex

    active = [p.name for p in plant.parameters.values() if p.range]
    x, u, p = ca.SX.sym("x", 12), ca.SX.sym("u", 3), ca.SX.sym("p", len(active))
    names = {q.name: q.value for q in plant.parameters.values()} | {
        n: x[i] for i, n in enumerate(plant.nodes)
    }
    names |= {q: p[i] for i, q in enumerate(active)} | {q: u[i] for i, q in enumerate(plant.inputs)}

    def value(e):
        a = [value(q) for q in e.args]
        simple = {
            "+": lambda: a[0] + a[1],
            "*": lambda: a[0] * a[1],
            "/": lambda: a[0] / a[1],
            "neg": lambda: -a[0],
        }
        return e.value if e.op == "num" else names[e.value] if e.op == "name" else simple[e.op]()

    f = ca.vertcat(
        *[
            sum(
                (1 if q.target == n.name else -1) * value(q.rate)
                for q in plant.flows.values()
                if n.name in (q.source, q.target)
            )
            / value(n.storage)
            for n in plant.nodes.values()
        ]
    )
    assert not any(ex.names(n.storage) & set(plant.nodes) for n in plant.nodes.values())
    S = ca.SX.sym("S", 12, len(active))
    slopes = ca.jacobian(f, x) @ S + ca.jacobian(f, p)
    options = {"reltol": RTOL, "abstol": RTOL, "max_num_steps": 100000}
    grid = list(table.t[1:])
    plain = ca.integrator("plain", "cvodes", {"x": x, "u": u, "p": p, "ode": f}, 0.0, grid, options)
    both = ca.integrator(
        "both",
        "cvodes",
        {"x": ca.vertcat(x, ca.vec(S)), "u": u, "p": p, "ode": ca.vertcat(f, ca.vec(slopes))},
        0.0,
        grid,
        options,
    )
    air = table.columns["air_c"]
    inputs = np.array(
        [table.columns["voltage_v"][:-1], table.columns["current_a"][:-1], 0.5 * (air[1:] + air[:-1])]
    )
    values = [plant.parameters[q].value for q in active]
    x0 = np.full(12, air[0])
    return (
        lambda: plain(x0=x0, u=inputs, p=values)["xf"],
        lambda: both(x0=np.concatenate([x0, np.zeros(12 * len(active))]), u=inputs, p=values)["xf"],
    )


def closed_loop(seconds):
    """CPU seconds for `seconds` of the daemon's own tick with the whole actuator as its rig."""
    from thermoctl.configuration.settings import load_settings
    from thermoctl.daemon.offline.simulate import Simulation

    rig = Simulation(load_settings("config/simulated.yaml"))
    rig.arm()
    rig.command("setpoint", 100.0)
    begin = time.process_time()
    rig.tick(round(seconds * 1000))
    spent = time.process_time() - begin
    rig.close()
    return spent


def law_and_plant(seconds):
    """The law (estimator, compensation, PID, protection) closed over the whole actuator, nothing between them: CPU seconds
    of `seconds`, how long the plant alone takes, and the position where the setpoint was 50 um."""
    from thermoctl.configuration.settings import load_settings
    from thermoctl.control import arming
    from thermoctl.control.law import Law
    from thermoctl.daemon.tick.assemble import compensator, law_parameters
    from thermoctl.rig.channels import CHANNELS

    settings = load_settings("config/simulated.yaml")
    model = compile_plant(load("config/plants/actuator.yaml"), ())
    stepper, u = model.stepper(1e-3, np.array([0.0, 22.0])), np.array([0.0, 22.0])
    value, fresh, status = (
        np.full(len(CHANNELS), 22.0),
        np.ones(len(CHANNELS), np.uint8),
        np.zeros(len(CHANNELS), np.uint8),
    )
    at = {name: CHANNELS.index(name) for name in model.outputs}
    assert list(at.values()) == [k for k, c in enumerate(CHANNELS) if c in at]
    readings = np.array(list(at.values()))
    value[CHANNELS.index("supply_v")], value[CHANNELS.index("amplifier_fault")] = 24.0, 0.0
    amplifier, air = CHANNELS.index("amplifier_state"), CHANNELS.index("air_c")
    law = Law(compensator(settings), law_parameters(settings), 1e-3)
    law.bind(value, fresh, status)
    noise = 1e-4 * np.random.default_rng(1).normal(
        size=(1024, len(readings))
    )  # a reading that never moves is a fault
    commands = {name: k for k, name in enumerate(arming.COMMANDS)}

    def ticks(count, command=0, target=0.0):
        for k in range(count):
            value[readings] = stepper.step(u) + noise[k & 1023]
            value[amplifier], value[air] = 1.0 + (law.enable > 0), 22.0 + noise[k & 1023, 0]
            law.step(1e-3, command if k == 0 else 0, target)
            u[0] = law.drive

    ticks(3000)
    ticks(1, commands["arm"])
    ticks(5000, commands["setpoint"], 50.0)
    begin = time.process_time()
    ticks(round(seconds * 1000))
    spent = time.process_time() - begin
    begin = time.process_time()
    for _ in range(round(seconds * 1000)):
        stepper.step(u)
    return spent, time.process_time() - begin, law.compensated_um, arming.STATES[law.state]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=14400)
    parser.add_argument("--peer-samples", type=int, default=720)
    args = parser.parse_args()
    plant = load("config/plants/actuator_thermal.yaml")
    begin = time.perf_counter()
    model = compile_plant(plant)
    print(
        f"compiled (or from the cache) in {time.perf_counter() - begin:.2f} s; {len(model.active)} parameters, rtol {RTOL:g}"
    )
    table, part = course(args.samples), course(args.peer_samples)
    share = args.samples / args.peer_samples
    drive, buffers = model.prepare(model.excitation(table)), {}
    ours, run = cpu(lambda: model.run(drive, rtol=RTOL), 5)
    ours_j, _ = cpu(lambda: model.run(drive, sensitivities=True, rtol=RTOL, buffers=buffers), 3)
    heat = thermal(plant)
    scipy_s, peer = cpu(lambda: scipy_run(heat, part), 1)
    scipy_j, differences = cpu(lambda: scipy_differences(plant, part), 1)
    exact = (
        model.run(model.excitation(part), sensitivities=True, rtol=RTOL)
        .dx[:, :, : len(model.active)]
        .transpose(2, 0, 1)
    )
    felt = np.abs(exact).max((1, 2)) > 0  # the expansions move no temperature
    print(
        f"largest difference to scipy: {np.max(np.abs(peer - run.x[: len(peer)])):.1e} K; of the Jacobian, as a share of each "
        f"parameter's largest slope: {np.max(np.abs(exact - differences).max((1, 2))[felt] / np.abs(exact).max((1, 2))[felt]):.1e}"
    )
    rows = [
        ("ours", ours, ours_j),
        (
            f"SciPy LSODA, finite differences in {len(model.active) + 1} measured runs, x {share:g} for the samples",
            scipy_s * share,
            scipy_j * share,
        ),
    ]
    try:
        plain, both, warm = numba_functions(plant, table)
        (a, states), (b, _) = cpu(plain, 2), cpu(both, 1)
        print(
            f"numba: compiled in {warm:.1f} s; largest difference to ours {np.max(np.abs(states - run.x)):.1e} K"
        )
        rows.append(("numba, the same method and expressions, dense matrices", a, b))
    except ImportError:
        print("numba is not installed (pip install '.[bench]'): left out")
    try:
        plain, both = casadi_functions(plant, part)
        rows.append(
            (f"CasADi CVODES, x {share:g} for the samples", cpu(plain, 1)[0] * share, cpu(both, 1)[0] * share)
        )
    except ImportError:
        print("CasADi is not installed (pip install '.[bench]'): left out")
    print(
        f"\n| {args.samples} samples, {len(model.active)} parameters, rtol {RTOL:g} | simulation | x ours | + Jacobian | x ours |\n"
        "|---|---:|---:|---:|---:|"
    )
    for label, a, b in rows:
        print(f"| {label} | {a:.4f} s | {a / ours:.3g} | {b:.3f} s | {b / ours_j:.3g} |")
    print()
    spent, alone, position, state = law_and_plant(20.0)
    print(
        f"closed loop of law and whole actuator at 1 ms: {20 / spent:.0f} times real time (of {spent * 50:.1f} us a tick the plant "
        f"takes {alone * 50:.1f}); state {state}, position {position:.3f} um of 50"
    )
    print(
        f"the same with the daemon's whole tick (sensors with noise, record row): {10 / closed_loop(10.0):.0f} times real time"
    )


if __name__ == "__main__":
    main()
