"""A signal is noted, and ends nothing before it is asked for."""

import os
import signal

import pytest

from contact_reach_ros.bringup.interruption import Interruption


@pytest.fixture
def handlers():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_raised_where_it_is_asked_for(number):
    interruption = Interruption()
    interruption.check()
    os.kill(os.getpid(), number)
    assert interruption.came
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            interruption.check()


@pytest.mark.usefixtures("handlers")
def test_what_comes_while_all_is_ended_is_ignored():
    interruption = Interruption()
    interruption.ignore()
    os.kill(os.getpid(), signal.SIGINT)
    interruption.check()
