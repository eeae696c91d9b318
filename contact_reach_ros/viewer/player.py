"""Playback of a recording: play, pause, speed, scrub, step."""

from __future__ import annotations

import bisect

from contact_reach_ros.viewer.recorded import Recording

SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")


class Player:
    """Position in a recording.

    Attributes
    ----------
    recording
        The recording to play.
    playing
        Whether time advances.
    speed
        Seconds of the recording per second.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.playing = False
        self.speed = 1.0
        self._time = 0.0

    @property
    def time(self) -> float:
        """Time since the first joint state, s."""
        return self._time

    def advance(self, seconds: float) -> None:
        """Advance the time while playing; stops at the end of the recording."""
        if self.playing:
            self._go(self._time + seconds * self.speed)
            self.playing = self._time < self.recording.duration

    def toggle(self) -> None:
        """Play or pause; from the end, play from the start."""
        if not self.playing and self._time >= self.recording.duration:
            self._time = 0.0
        self.playing = not self.playing

    def seek(self, time: float) -> None:
        """Jump to a time, s; playback continues from there if it is on."""
        self._go(time)

    def step(self, ticks: int) -> None:
        """Pause and move by some joint states, forward or back."""
        self.playing = False
        row = self.recording.tick(self._time) + ticks
        self._go(float(self.recording.ticks[min(max(row, 0), len(self.recording.ticks) - 1)]))

    def jump(self) -> bool:
        """Pause at the start of the next contact; returns whether there is one."""
        time = self.recording.next_contact(self._time)
        if time is None:
            return False
        self.playing = False
        self._go(time)
        return True

    def last_event(self) -> str:
        """The last event in words; empty before the first."""
        events = self.recording.events
        row = bisect.bisect_right([event.time for event in events], self._time + 1e-6) - 1
        return f"{events[row].time:.2f} s: {events[row].text}" if row >= 0 else ""

    def _go(self, time: float) -> None:
        self._time = min(max(time, 0.0), self.recording.duration)
