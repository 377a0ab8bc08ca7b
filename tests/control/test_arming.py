"""The arming machine as a whole: every state, command and condition, and long sequences of them."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from thermoctl.control import arming
from thermoctl.control.arming import ARM, ARMED, DISARM, FAULT, OFF, READY, SAFE, next_state

STATES, COMMANDS, BOOLS = range(5), range(4), (False, True)


def cases():
    return itertools.product(STATES, COMMANDS, BOOLS, BOOLS, BOOLS)


def test_only_ready_and_a_command_lead_to_armed():
    for state, command, started, tripped, critical in cases():
        new = next_state(state, command, started, tripped, critical)
        if new == ARMED and state != ARMED:
            assert (state, command, started, tripped, critical) == (READY, ARM, True, False, False)


def test_armed_is_left_at_once():
    for state, command, started, tripped, critical in cases():
        if tripped or critical or not started or (state, command) == (ARMED, DISARM):
            assert next_state(state, command, started, tripped, critical) != ARMED


def test_fault_latches_until_acknowledged_and_gone():
    for command, tripped, critical in itertools.product(COMMANDS, BOOLS, BOOLS):
        expected = SAFE if command == DISARM and not tripped and not critical else FAULT
        assert next_state(FAULT, command, True, tripped, critical) == expected


def test_the_way_up():
    assert next_state(OFF, ARM, False, False, False) == OFF
    assert next_state(OFF, ARM, True, False, False) == SAFE
    assert next_state(SAFE, ARM, True, False, False) == READY
    assert next_state(READY, arming.NONE, True, True, False) == SAFE
    assert next_state(READY, ARM, True, False, False) == ARMED
    assert next_state(ARMED, DISARM, True, False, False) == SAFE
    assert next_state(SAFE, arming.NONE, True, True, True) == FAULT


@given(st.lists(st.tuples(st.sampled_from(COMMANDS), st.booleans(), st.booleans())))
def test_no_path_to_armed_without_a_fresh_command(events):
    """Along any path: each entry into ARMED has its own ARM command in that very tick, none while tripped."""
    state = OFF
    for command, tripped, critical in events:
        tripped = tripped or critical
        new = next_state(state, command, True, tripped, critical)
        assert new in STATES
        if new == ARMED:
            assert not tripped and (state == ARMED or command == ARM)
        state = new
