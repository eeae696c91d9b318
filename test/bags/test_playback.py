import threading
import time
from collections.abc import Iterator

import pytest

from contact_reach_ros.bags.playback import Playback, read_ahead
from contact_reach_ros.bags.reader import RawMessage

START = 1_700_000_000_000_000_000
MS = 1_000_000


def message(at_ms: float, topic: str = "/a") -> RawMessage:
    return RawMessage(topic, "std_msgs/msg/String", START + int(at_ms * MS), 0, topic.encode(), 0)


class Taker:
    """Runs a playback in a thread, and notes what it hands out, and when."""

    def __init__(self, playback: Playback, messages: list[RawMessage]) -> None:
        self.playback = playback
        self.taken: list[tuple[RawMessage, int]] = []
        self.whole: bool | None = None
        self.thread = threading.Thread(target=self._run, args=[messages])
        self.began_ns = time.monotonic_ns()
        self.thread.start()

    def _run(self, messages: list[RawMessage]) -> None:
        self.whole = self.playback.run(messages, START, lambda raw: self.taken.append((raw, time.monotonic_ns())))

    def until(self, count: int) -> None:
        deadline = time.monotonic() + 30.0
        while len(self.taken) < count:
            assert time.monotonic() < deadline, f"{len(self.taken)} of {count} messages"
            time.sleep(0.001)

    def end(self) -> None:
        self.thread.join(30.0)
        assert not self.thread.is_alive()


@pytest.mark.parametrize("rate", [1.0, 4.0, 0.5])
def test_no_message_comes_before_its_time(rate: float) -> None:
    messages = [message(at) for at in (0, 1, 1, 1.5, 30, 31, 60)]
    taker = Taker(Playback(rate), messages)
    taker.end()
    assert taker.whole is True
    assert [raw for raw, _ in taker.taken] == messages
    for raw, at_ns in taker.taken:
        assert at_ns - taker.began_ns >= (raw.log_time_ns - START) / rate
    assert taker.playback.count == len(messages)


def test_message_behind_its_time_is_handed_out_with_the_one_before() -> None:
    taker = Taker(Playback(), [message(at) for at in (0, 20, 5, 21)])
    taker.end()
    assert [raw.log_time_ns - START for raw, _ in taker.taken] == [0, 20 * MS, 5 * MS, 21 * MS]


def test_pause_holds_the_next_message_back() -> None:
    playback = Playback()
    taker = Taker(playback, [message(0), message(100)])
    taker.until(1)
    playback.pause()
    time.sleep(0.2)
    assert len(taker.taken) == 1
    playback.resume()
    taker.end()
    assert len(taker.taken) == 2


def test_stop_ends_it_at_once_also_in_a_pause() -> None:
    for paused in (False, True):
        playback = Playback(paused=paused)
        taker = Taker(playback, [message(3_600_000)])
        playback.stop()
        taker.end()
        assert taker.whole is False
        assert taker.taken == []


def test_after_a_long_delay_messages_keep_their_distances() -> None:
    playback = Playback()
    times: list[int] = []

    def publish(_: RawMessage) -> None:
        times.append(time.monotonic_ns())
        if len(times) == 1:
            time.sleep(0.7)

    playback.run([message(0), message(10), message(60)], START, publish)
    assert times[2] - times[1] >= 49 * MS


def test_messages_read_ahead_are_the_same() -> None:
    messages = [message(at) for at in range(10_000)]
    assert list(read_ahead(messages)) == messages


def test_error_of_the_reader_comes_where_the_messages_are_asked_for() -> None:
    def broken() -> Iterator[RawMessage]:
        yield message(0)
        raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        list(read_ahead(broken()))


def test_reader_ends_when_nobody_wants_more() -> None:
    def endless() -> Iterator[RawMessage]:
        while True:
            yield message(0)

    before = threading.active_count()
    messages = read_ahead(endless())
    next(messages)
    messages.close()
    assert threading.active_count() == before
