"""Playback of a bag, and the tab that opens bags and plays them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import viser

from contact_reach_ros.arm import Arm
from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.viewer.recorded import Recording

_MARKS = 30
"""Greatest number of events marked on the timeline and listed."""
_LABELS = {"stop": "STOP", "goal": "goal", "contact": ""}
"""Labels of the kinds of events on the timeline, the most important first."""
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_STEPS = {"− 1 tick": -1, "+ 1 tick": 1, "+ 10 ticks": 10}


def bag_directory(bag: Path) -> Path:
    """Directory of a bag that is named by its directory or by one of its files."""
    return bag if bag.is_dir() else bag.parent


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
    time
        Time since the first joint state, s.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.playing = False
        self.speed = 1.0
        self.time = 0.0

    def advance(self, seconds: float) -> None:
        """Advance the time while playing; stops at the end of the recording."""
        if self.playing:
            self.seek(self.time + seconds * self.speed)
            self.playing = self.time < self.recording.duration

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

    def jump(self) -> bool:
        """Pause at the start of the next contact; returns whether there is one."""
        later = (event.time for event in self.recording.events if event.kind == "contact")
        time = next((start for start in later if start > self.time + 1e-6), None)
        if time is None:
            return False
        self.playing = False
        self.seek(time)
        return True


class BagTab:
    """Opens the bags of a folder and plays them.

    Parameters
    ----------
    server
        Server of the page.
    folder
        Folder of the bags to choose from.
    arm
        The arm of the page.
    say
        Shows a line on the page.

    Attributes
    ----------
    player
        Player of the open bag; None while the running stack is shown.
    """

    def __init__(self, server: viser.ViserServer, folder: Path, arm: Arm, say: Callable[[str], None]) -> None:
        self.player: Player | None = None
        self._bags = folder
        self._arm = arm
        self._say = say
        self._gui = gui = server.gui
        self._controls: list[Any] = []
        self._choice: Any = gui.add_dropdown("Bag", self._names() or ["none"])
        open_it = gui.add_button("Open", icon=viser.Icon.FOLDER_OPEN)
        self._back = gui.add_button("Back to live", visible=False, icon=viser.Icon.ARROW_BACK_UP)
        self._folder = gui.add_folder("Playback", visible=False)

        @open_it.on_click
        async def _(_: Any) -> None:
            await self._open_by_name(self._choice.value)

        @self._back.on_click
        async def _(_: Any) -> None:
            self.open(None)

    def open(self, recording: Recording | None) -> None:
        """Show a recording from its first goal on, with its controls, or the running stack again."""
        for control in self._controls:
            control.remove()
        self._controls = []
        self.player = None if recording is None else Player(recording)
        self._folder.visible = self._back.visible = recording is not None
        self._choice.options = self._names() or ["none"]
        if recording is not None and self.player is not None:
            name = bag_directory(recording.path).name
            self._choice.options = list(dict.fromkeys([name, *self._names()]))
            self._choice.value = name
            self.player.seek(next((event.time for event in recording.events if event.kind == "goal"), 0.0))
            with self._folder:
                self._add_controls(self.player)

    def follow(self) -> None:
        """Update the controls to the player's position."""
        player = self.player
        if player is None:
            return
        # viser sends a value to the browsers only when it changes.
        self._slider.value = round(player.time, 3)
        self._play.label = "Pause" if player.playing else "Play"

    def _names(self) -> list[str]:
        return sorted((file.parent.name for file in self._bags.glob("*/*.mcap")), reverse=True)

    async def _open_by_name(self, name: str) -> None:
        if name not in self._names():
            self._say(f"there is no bag '{name}' in {self._bags}")
            self._choice.options = self._names() or ["none"]
            return
        self._say(f"opening {name} ...")
        try:
            self.open(await asyncio.to_thread(Recording, self._bags / name, self._arm))
        except ContactReachError as error:
            self._say(str(error))
            return
        self._say(f"{name} is open")

    def _add_controls(self, player: Player) -> None:
        gui, recording = self._gui, player.recording
        duration = max(round(recording.duration, 3), 0.001)
        marked = [event for kind in _LABELS for event in recording.events if event.kind == kind][:_MARKS]
        marks = tuple((min(round(event.time, 3), duration), _LABELS[event.kind]) for event in marked)
        self._slider: Any = gui.add_slider("Time (s)", 0.0, duration, 0.001, round(player.time, 3), marks=marks)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        speed = gui.add_dropdown("Speed (s per s)", _SPEEDS, initial_value="1")
        step = gui.add_button_group("Step", tuple(_STEPS))
        jump = gui.add_button("Next contact", icon=viser.Icon.PLAYER_SKIP_FORWARD)
        lines = [f"- {event.time:.2f} s: {event.text}" for event in recording.events[:_MARKS]]
        if len(recording.events) > _MARKS:
            lines.append(f"- and {len(recording.events) - _MARKS} more")
        table = gui.add_markdown("**Events**\n\n" + ("\n".join(lines) or "none"))
        self._controls = [self._slider, self._play, speed, step, jump, table]

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
            if not player.jump():
                self._say("no later contact")
