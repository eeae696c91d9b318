"""Playback of a bag, and the tab with its controls."""

from __future__ import annotations

from typing import Any

import viser

from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.viewer.recorded import Recording

_MARKS = 30
"""Greatest number of events marked on the timeline and listed."""
_LABELS = {"stop": "STOP", "goal": "goal", "contact": ""}
"""Labels of the kinds of events on the timeline, the most important first."""
_ROOM = 0.18
"""Share of the timeline that a label needs for itself."""
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_STEPS = {"− 1 tick": -1, "+ 1 tick": 1, "+ 10 ticks": 10}


class Player:
    """Position in a recording, at first that of its first goal.

    Attributes
    ----------
    recording
        The recording to play.
    playing
        Whether time advances.
    speed
        Seconds of the recording per second.
    time
        Time since the first joint state, s.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.playing = False
        self.speed = 1.0
        self.time = next((event.time for event in recording.events if event.kind == "goal"), 0.0)

    def frame(self, passed: float) -> Frame:
        """The moment after `passed` s, for which time advances while playing, up to the end of the recording."""
        if self.playing:
            self.seek(self.time + passed * self.speed)
            self.playing = self.time < self.recording.duration
        return self.recording.frame(self.time)

    def toggle(self) -> None:
        """Play or pause; from the end, play from the start."""
        if not self.playing and self.time >= self.recording.duration:
            self.time = 0.0
        self.playing = not self.playing

    def seek(self, time: float) -> None:
        """Jump to a time, s; playback continues from there if it is on."""
        self.time = min(max(time, 0.0), self.recording.duration)

    def step(self, ticks: int) -> None:
        """Pause and move by some joint states, forward or back."""
        self.playing = False
        row = self.recording.tick(self.time) + ticks
        self.seek(float(self.recording.ticks[min(max(row, 0), len(self.recording.ticks) - 1)]))

    def jump(self) -> None:
        """Pause at the start of the next contact; stay where there is none."""
        later = (event.time for event in self.recording.events if event.kind == "contact")
        self.playing = False
        self.seek(next((start for start in later if start > self.time + 1e-6), self.time))


class BagTab:
    """Controls of a player, in the GUI container that is open at construction."""

    def __init__(self, server: viser.ViserServer, player: Player) -> None:
        self._player = player
        gui, recording = server.gui, player.recording
        duration = max(round(recording.duration, 3), 0.001)
        marked = [event for kind in _LABELS for event in recording.events if event.kind == kind][:_MARKS]
        marks: list[tuple[float, str]] = []
        for event in marked:
            time = min(round(event.time, 3), duration)
            is_free = all(abs(time - other) > _ROOM * duration for other, label in marks if label)
            marks.append((time, _LABELS[event.kind] if is_free else ""))
        self._slider: Any = gui.add_slider("Time (s)", 0.0, duration, 0.001, round(player.time, 3), marks=tuple(marks))
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        speed = gui.add_dropdown("Speed (s per s)", _SPEEDS, initial_value="1")
        step = gui.add_button_group("Step", tuple(_STEPS))
        jump = gui.add_button("Next contact", icon=viser.Icon.PLAYER_SKIP_FORWARD)
        lines = [f"- {event.time:.2f} s: {event.text}" for event in recording.events[:_MARKS]]
        if len(recording.events) > _MARKS:
            lines.append(f"- and {len(recording.events) - _MARKS} more")
        gui.add_markdown("**Events**\n\n" + ("\n".join(lines) or "none"))

        @self._slider.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is not None:
                player.seek(float(event.target.value))

        @self._play.on_click
        async def _(_: Any) -> None:
            player.toggle()

        @speed.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            player.speed = float(event.target.value)

        @step.on_click
        async def _(event: viser.GuiEvent[Any]) -> None:
            player.step(_STEPS[event.target.value])

        @jump.on_click
        async def _(_: Any) -> None:
            player.jump()

    def show(self, _: Frame | None) -> None:
        """Update the controls to the player's position."""
        # viser sends a value to the browsers only when it changes.
        self._slider.value = round(self._player.time, 3)
        self._play.label = "Pause" if self._player.playing else "Play"
