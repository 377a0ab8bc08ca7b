"""Plant simulation against its peers, in one run, on the 12-node actuator: CPU times and their ratios.

    python tests/bench/plant.py [--samples 14400] [--peer-samples 720]

The peers get the same equations, inputs and tolerance. They are timed on --peer-samples and scaled to --samples (their
cost is proportional), because the whole run would take them many minutes; what is scaled is said in the output.
"""
import argparse
import time

import numpy as np
from scipy.integrate import solve_ivp

from thermoctl.plant import load
from thermoctl.plant.linearise import thermal
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
    return Table("bench", "bench", t, {"voltage_v": 5 * current, "current_a": current, "air_c": 22 + 0.5 * np.sin(t / 1200)})


def scipy_run(heat, table, plant):
    """The linear network in hand-written numpy, LSODA, steps no longer than the samples."""
    power, air = table.columns["voltage_v"] * table.columns["current_a"], table.columns["air_c"]
    A, b, film = heat.A, heat.b, -heat.A.sum(axis=1)
    n = len(table.t)

    def slopes(t, x):
        k = min(int(t), n - 2)
        return A @ x + b * power[k] + film * (air[k] + (t - k) * (air[k + 1] - air[k]))
    return solve_ivp(slopes, (0, table.t[-1]), np.full(12, air[0]), "LSODA", t_eval=table.t, rtol=RTOL, atol=RTOL, max_step=1.0).y.T


def casadi_functions(plant, table):
    """CVODES over the samples: the states, and the states with all their sensitivities as further equations."""
    import casadi as ca

    from thermoctl.plant import expression as ex
    active = [p.name for p in plant.parameters.values() if p.range]
    x, u, p = ca.SX.sym("x", 12), ca.SX.sym("u", 3), ca.SX.sym("p", len(active))
    names = {q.name: q.value for q in plant.parameters.values()} | {n: x[i] for i, n in enumerate(plant.nodes)}
    names |= {q: p[i] for i, q in enumerate(active)} | {q: u[i] for i, q in enumerate(plant.inputs)}

    def value(e):
        a = [value(q) for q in e.args]
        simple = {"+": lambda: a[0] + a[1], "*": lambda: a[0] * a[1], "/": lambda: a[0] / a[1], "neg": lambda: -a[0]}
        return e.value if e.op == "num" else names[e.value] if e.op == "name" else simple[e.op]()
    f = ca.vertcat(*[sum((1 if q.target == n.name else -1) * value(q.rate) for q in plant.flows.values()
                         if n.name in (q.source, q.target)) / value(n.storage) for n in plant.nodes.values()])
    assert not any(ex.names(n.storage) & set(plant.nodes) for n in plant.nodes.values())
    S = ca.SX.sym("S", 12, len(active))
    slopes = ca.jacobian(f, x) @ S + ca.jacobian(f, p)
    options = {"reltol": RTOL, "abstol": RTOL, "max_num_steps": 100000}
    grid = list(table.t[1:])
    plain = ca.integrator("plain", "cvodes", {"x": x, "u": u, "p": p, "ode": f}, 0.0, grid, options)
    both = ca.integrator("both", "cvodes", {"x": ca.vertcat(x, ca.vec(S)), "u": u, "p": p, "ode": ca.vertcat(f, ca.vec(slopes))},
                         0.0, grid, options)
    air = table.columns["air_c"]
    inputs = np.array([table.columns["voltage_v"][:-1], table.columns["current_a"][:-1], 0.5 * (air[1:] + air[:-1])])
    values = [plant.parameters[q].value for q in active]
    x0 = np.full(12, air[0])
    return (lambda: plain(x0=x0, u=inputs, p=values)["xf"],
            lambda: both(x0=np.concatenate([x0, np.zeros(12 * len(active))]), u=inputs, p=values)["xf"])


def closed_loop(seconds):
    """CPU seconds for `seconds` of the daemon's own tick with the whole actuator as its rig."""
    from thermoctl.daemon.simulate import Simulation
    from thermoctl.settings import load_settings
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
    from thermoctl.control import arming
    from thermoctl.control.faults import CHANNELS
    from thermoctl.control.law import Law
    from thermoctl.daemon.assemble import compensator, law_parameters
    from thermoctl.settings import load_settings
    settings = load_settings("config/simulated.yaml")
    model = load("config/plants/actuator.yaml").compile(())
    stepper, u = model.stepper(1e-3, np.array([0.0, 22.0])), np.array([0.0, 22.0])
    value, fresh, status = np.full(len(CHANNELS), 22.0), np.ones(len(CHANNELS), np.uint8), np.zeros(len(CHANNELS), np.uint8)
    at = {name: CHANNELS.index(name) for name in model.outputs}
    assert list(at.values()) == [k for k, c in enumerate(CHANNELS) if c in at]
    readings = np.array(list(at.values()))
    value[CHANNELS.index("supply_v")], value[CHANNELS.index("amplifier_fault")] = 24.0, 0.0
    amplifier = CHANNELS.index("amplifier_state")
    law = Law(compensator(settings), law_parameters(settings), 1e-3)
    law.bind(value, fresh, status)
    commands = {name: k for k, name in enumerate(arming.COMMANDS)}

    def ticks(count, command=0, target=0.0):
        for k in range(count):
            value[readings] = stepper.step(u)
            value[amplifier] = 1.0 + (law.enable > 0)
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
    model = plant.compile()
    print(f"compiled (or from the cache) in {time.perf_counter() - begin:.2f} s; {len(model.active)} parameters, rtol {RTOL:g}")
    table, part = course(args.samples), course(args.peer_samples)
    share = args.samples / args.peer_samples
    drive, buffers = model.prepare(model.drive(table)), {}
    ours, run = cpu(lambda: model.run(drive, rtol=RTOL), 5)
    ours_j, _ = cpu(lambda: model.run(drive, sensitivities=True, rtol=RTOL, buffers=buffers), 3)
    heat = thermal(plant)
    scipy_s, peer = cpu(lambda: scipy_run(heat, part, plant), 1)
    print(f"largest difference to scipy: {np.max(np.abs(peer - run.x[:len(peer)])):.1e} K")
    scipy_s *= share
    rows = [("ours", ours, ours_j), (f"scipy LSODA + finite differences (x{share:g} scaled, {len(model.active) + 1} runs)", scipy_s,
                                     scipy_s * (len(model.active) + 1))]
    try:
        plain, both = casadi_functions(plant, part)
        rows.append((f"CasADi CVODES (x{share:g} scaled)", cpu(plain, 1)[0] * share, cpu(both, 1)[0] * share))
    except ImportError:
        print("CasADi is not installed (pip install '.[bench]'): left out")
    print(f"{'':62}{'simulation':>12}{'ratio':>8}{'+ Jacobian':>12}{'ratio':>8}")
    for label, a, b in rows:
        print(f"{label:62}{a:10.4f} s{a / ours:8.0f}{b:10.3f} s{b / ours_j:8.0f}")
    spent, alone, position, state = law_and_plant(20.0)
    print(f"closed loop of law and whole actuator at 1 ms: {20 / spent:.0f} times real time (of {spent * 50:.1f} us a tick the plant "
          f"takes {alone * 50:.1f}); state {state}, position {position:.3f} um of 50")
    print(f"the same with the daemon's whole tick (sensors with noise, record row): {10 / closed_loop(10.0):.0f} times real time")


if __name__ == "__main__":
    main()
