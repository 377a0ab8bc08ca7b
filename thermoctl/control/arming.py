"""Arming: OFF -> SAFE -> READY -> ARMED, and FAULT, which latches. A pure state machine, one call per tick.

    state   meaning                                  leaves to
    OFF     starting, no estimate is valid yet       SAFE when the law has run its self-test (`started`)
    SAFE    amplifier disabled                       READY when no fault forbids arming
    READY   amplifier disabled, may be armed         ARMED on the ARM command; SAFE when a fault trips
    ARMED   amplifier enabled, position controlled   SAFE on DISARM; FAULT when a fault trips
    FAULT   amplifier disabled, latched              SAFE on DISARM (acknowledged) once the cause is gone

A critical fault leads to FAULT from every state but OFF. Only a command that arrives in READY can arm. An
earlier command is not remembered, so power-up, restart and cleared faults never arm by themselves.
"""

from __future__ import annotations

OFF, SAFE, READY, ARMED, FAULT = range(5)
STATES = ("OFF", "SAFE", "READY", "ARMED", "FAULT")

NONE, ARM, DISARM, SETPOINT = range(4)
"""Commands. SETPOINT does not change the state."""
COMMANDS = ("none", "arm", "disarm", "setpoint")


def next_state(state: int, command: int, started: bool, tripped: bool, critical: bool) -> int:
    """Return the state after this tick.

    started: the law has run its self-test. tripped: an active fault forbids driving. critical: an active
    fault latches from every state (implies tripped)."""
    if not started or state == OFF:
        return SAFE if started else OFF
    if critical:
        return FAULT
    if state == ARMED:
        if tripped:
            return FAULT
        return SAFE if command == DISARM else ARMED
    if state == FAULT:
        return SAFE if command == DISARM and not tripped else FAULT
    if tripped:
        return SAFE
    if state == READY and command == ARM:
        return ARMED
    return READY


TABLE = bytes(
    next_state(state, command, started, tripped, critical)
    for state in range(len(STATES))
    for command in range(len(COMMANDS))
    for started in (False, True)
    for tripped in (False, True)
    for critical in (False, True)
)
"""Table of `next_state` for every input, the last argument changing fastest; the compiled tick reads it."""
