"""The page: scene, banner, buttons, plots, playback and settings, put together."""

from __future__ import annotations

import asyncio
import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.robot.kinematics import link_frames
from contact_reach_ros.scenes.files import scene_names
from contact_reach_ros.viewer.banner import Banner
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.viewer.live import LiveState
from contact_reach_ros.viewer.player import SPEEDS, Player
from contact_reach_ros.viewer.plots import BAG_AXIS, LIVE_AXIS, Plots
from contact_reach_ros.viewer.reach import reach
from contact_reach_ros.viewer.recorded import Recording
from contact_reach_ros.viewer.scene import ScenePart, Wish

Array = NDArray[np.float64]
T = TypeVar("T")

_PLOT_PERIOD = 0.2
_REACH_PERIOD = 0.15
_MOVED = 0.02
"""So far a joint has to turn before the goal is looked at again, rad."""
_TIMELINE_PERIOD = 0.2
_MARKS = 30


class Parameter(NamedTuple):
    """A parameter of a node as it is declared.

    Attributes
    ----------
    name
        With its prefix.
    value
        At present: a boolean, a number or a text.
    description
        With its unit.
    minimum, maximum
        None where there is no such limit.
    """

    name: str
    value: bool | int | float | str
    description: str
    minimum: float | None
    maximum: float | None


class Actions(Protocol):
    """What a user can do to the running stack. All may take seconds, and return a line that says what came of it."""

    def send_goal(self, position: Array) -> str:
        """Command a flange position (3,), m."""

    def stop(self) -> str:
        """Stop the arm."""

    def reset(self) -> str:
        """Release all stops."""

    def restart(self, scene: str, seed: int) -> str:
        """Begin another episode in simulation."""

    def nodes(self) -> Sequence[str]:
        """The nodes that have parameters."""

    def parameters(self, node: str) -> Sequence[Parameter]:
        """The parameters of a node; raises `ContactReachError` when it does not answer."""

    def apply(self, node: str, values: Mapping[str, bool | int | float | str]) -> str:
        """Change parameters of a node."""


@dataclass(frozen=True)
class Source:
    """Where a page's data comes from.

    Attributes
    ----------
    live
        A running stack; None for a page that only plays bags.
    actions
        What can be done to it, with it.
    bags
        Folder whose bags the page offers.
    open_bag
        Opens one.
    """

    live: LiveState | None
    actions: Actions | None
    bags: Path
    open_bag: Callable[[Path], Recording]


class Page:
    """The page on a server.

    `turn` has to be called again and again, at most as often as the page is to move. All is to be called in the
    server's own thread (`access.call`): viser's buffers are not safe in others. What takes long is done elsewhere.
    """

    def __init__(
        self, server: viser.ViserServer, source: Source, budget: ContactBudget, shadows: bool = True, dark: bool = False
    ) -> None:
        self._server = server
        self._source = source
        self._player: Player | None = None
        self._frame: Frame | None = None
        self._plots_due = self._reach_due = self._timeline_due = 0.0
        self._asked: tuple[Array, Array] | None = None
        self._last = 0.0
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", dark_mode=dark)
        server.scene.configure_default_lights(cast_shadow=shadows)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(360)
        self._scene = ScenePart(server, budget.torque_thresholds, budget.permitted_force)
        self._banner = Banner(server, budget.torque_thresholds)
        self._wish: Wish | None = None
        actions = source.actions
        if actions is not None:
            self._add_stop(actions)
        self._said = server.gui.add_html("")
        tabs = server.gui.add_tab_group()
        if actions is not None:
            with tabs.add_tab("Goal"):
                self._add_goal(actions)
        with tabs.add_tab("Plots"):
            self._plots = Plots(server, budget.permitted_force)
        with tabs.add_tab("Bag"):
            self._bag = _BagPart(server, self)
        if actions is not None:
            with tabs.add_tab("Scene"):
                _add_episode(server, actions, self.say)
            with tabs.add_tab("Tune"):
                _TunePart(server, actions, self.say)

    def turn(self, clock: float) -> None:
        """Bring the page up to date; `clock` is a steady clock, s."""
        passed, self._last = clock - self._last, clock
        live = self._source.live
        frame = live.frame() if live is not None else None
        if not self._server.get_clients():
            return
        player = self._player
        silence: float | None = None
        if player is not None:
            player.advance(passed)
            frame = player.recording.frame(player.time)
            source = f"bag {player.recording.path.name}, {player.time:.3f} s"
        elif live is not None:
            silence = live.silence(clock)
            source = "live"
        else:
            self._banner.show("no bag is open: choose one under 'Bag'", None, 0.0)
            return
        self._frame = frame
        self._banner.show(source, frame, silence)
        if frame is not None:
            self._scene.show(frame)
        if clock >= self._plots_due:
            self._plots_due = clock + _PLOT_PERIOD
            self._show_plots(player)
        if player is not None and clock >= self._timeline_due:
            self._timeline_due = clock + _TIMELINE_PERIOD
            self._bag.follow(player)
        self._show_reach(clock)

    def open(self, recording: Recording | None) -> None:
        """Show a recording, or the running stack again."""
        self._player = None if recording is None else Player(recording)
        self._plots_due = 0.0
        self._bag.take(self._player)

    def bags(self) -> list[str]:
        """Names of the bags that can be opened."""
        folder = self._source.bags
        return sorted((file.parent.name for file in folder.glob("*/*.mcap")), reverse=True) if folder.is_dir() else []

    async def open_by_name(self, name: str) -> None:
        """Open one of `bags`; what is wrong with it is said on the page."""
        if name not in self.bags():
            self.say(f"there is no bag '{name}' in {self._source.bags}")
            return
        self.say(f"opening {name} ...")
        try:
            self.open(await _elsewhere(self._source.open_bag, self._source.bags / name))
        except ContactReachError as error:
            self.say(str(error))
            return
        self.say(f"{name} is open")

    @property
    def has_live(self) -> bool:
        """Whether there is a stack to go back to."""
        return self._source.live is not None

    def say(self, text: str) -> None:
        """Show a line to all who look."""
        self._said.content = f'<div style="padding:0 10px 6px;font-size:13px">{html.escape(text)}</div>'

    def _add_stop(self, actions: Actions) -> None:
        gui = self._server.gui
        stop = gui.add_button("Stop", color="red", icon=viser.Icon.HAND_STOP, hint="compliant stop of the live arm")
        reset = gui.add_button("Reset", color="gray", icon=viser.Icon.REFRESH, hint="release the stop of the live arm")

        @stop.on_click
        async def _(_: Any) -> None:
            self.say(await _elsewhere(actions.stop))

        @reset.on_click
        async def _(_: Any) -> None:
            self.say(await _elsewhere(actions.reset))

    def _add_goal(self, actions: Actions) -> None:
        gui = self._server.gui
        gui.add_markdown("Drag the arrows in the scene, or type. Nothing moves before you send it.")
        field: Any = gui.add_vector3(
            "Goal (m)", (0.0, 0.0, 0.0), step=0.001, hint="flange position in lbr_link_0: x, y, z"
        )
        self._reach_text = gui.add_markdown("")
        send = gui.add_button("Send goal", color="blue", icon=viser.Icon.SEND)
        here = gui.add_button("Put it at the flange", color="gray")
        self._send = send

        def moved(position: Array) -> None:
            field.value = tuple(np.round(position, 4).tolist())

        wish = self._wish = Wish(self._server, moved)
        self._field = field
        wish.show(False)

        @field.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is not None:
                wish.put(np.array(event.target.value))

        @send.on_click
        async def _(_: Any) -> None:
            self.say(await _elsewhere(actions.send_goal, wish.position.copy()))

        @here.on_click
        async def _(_: Any) -> None:
            self._place_wish()

    def _place_wish(self) -> None:
        if self._frame is not None and self._wish is not None:
            position = np.round(link_frames(self._frame.q)[1][-1], 3)
            self._wish.put(position)
            self._field.value = tuple(position.tolist())

    def _show_reach(self, clock: float) -> None:
        wish, frame = self._wish, self._frame
        if wish is None:
            return
        playing = self._player is not None
        wish.show(frame is not None and not playing)
        if self._send.disabled != playing:
            self._send.disabled = playing
        if frame is None or playing or clock < self._reach_due:
            return
        if self._asked is None:
            self._place_wish()
        if self._asked is not None:
            position, q = self._asked
            if np.array_equal(position, wish.position) and np.abs(frame.q - q).max() < _MOVED:
                return
        self._reach_due = clock + _REACH_PERIOD
        self._asked = wish.position.copy(), frame.q.copy()
        answer = reach(*self._asked)
        wish.mark(answer.reachable)
        self._reach_text.content = f"{'✔' if answer.reachable else '✘'} {answer.text}"

    def _show_plots(self, player: Player | None) -> None:
        if player is not None:
            self._plots.show(player.recording.table(player.time), BAG_AXIS)
        elif self._source.live is not None:
            table = self._source.live.history.table()
            if len(table):
                table[:, 0] -= table[-1, 0]
            self._plots.show(table, LIVE_AXIS)


class _BagPart:
    """Which bag, and where in it."""

    def __init__(self, server: viser.ViserServer, page: Page) -> None:
        self._gui = gui = server.gui
        self._page = page
        self._player: Player | None = None
        self._slider: Any = None
        self._parts: list[Any] = []
        names = page.bags()
        self._choice = gui.add_dropdown("Bag", names or ["none"])
        open_it = gui.add_button("Open", icon=viser.Icon.FOLDER_OPEN)
        again = gui.add_button("Look for bags again", color="gray")
        self._back = gui.add_button("Back to live", visible=False, icon=viser.Icon.ARROW_BACK_UP)
        self._folder = gui.add_folder("Playback", visible=False)

        @open_it.on_click
        async def _(_: Any) -> None:
            await page.open_by_name(self._choice.value)

        @again.on_click
        async def _(_: Any) -> None:
            found = page.bags()
            self._choice.options = found or ["none"]
            page.say(f"bags found: {len(found)}")

        @self._back.on_click
        async def _(_: Any) -> None:
            page.open(None)

    def take(self, player: Player | None) -> None:
        """Show the controls of a recording, or none."""
        for part in self._parts:
            part.remove()
        self._parts = []
        self._slider, self._player = None, player
        self._folder.visible = player is not None
        self._back.visible = player is not None and self._page.has_live
        if player is not None:
            with self._folder:
                self._add(player)

    def follow(self, player: Player) -> None:
        """Show where the player is."""
        slider = self._slider
        if slider is None or player is not self._player:
            return
        time = round(player.time, 3)
        if slider.value != time:
            slider.value = time
            self._event.content = player.last_event() or "nothing has happened yet"
        label = "Pause" if player.playing else "Play"
        if self._play.label != label:
            self._play.label = label

    def _add(self, player: Player) -> None:
        gui, recording = self._gui, player.recording
        duration = max(round(recording.duration, 3), 0.001)
        events = [event for event in recording.events if event.kind in ("goal", "stop", "contact")]
        kinds = {"goal": "goal", "stop": "STOP", "contact": ""}
        chosen = sorted(events, key=lambda event: ("stop", "goal", "contact").index(event.kind))[:_MARKS]
        marks = tuple((min(round(event.time, 3), duration), kinds[event.kind]) for event in chosen)
        slider = gui.add_slider("Time (s)", 0.0, duration, 0.001, 0.0, marks=marks)
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        speed = gui.add_dropdown("Speed (s per s)", SPEEDS, initial_value="1")
        step = gui.add_button_group("Step", ("− 1 tick", "+ 1 tick", "+ 10 ticks"))
        jump = gui.add_button("Next contact", icon=viser.Icon.PLAYER_SKIP_FORWARD)
        self._event = gui.add_markdown("")
        lines = [f"- {event.time:.2f} s: {event.text}" for event in recording.events[:_MARKS]]
        if len(recording.events) > _MARKS:
            lines.append(f"- and {len(recording.events) - _MARKS} more")
        table = gui.add_markdown("**Events**\n\n" + ("\n".join(lines) or "none"))
        self._slider = slider
        self._parts = [slider, self._play, speed, step, jump, self._event, table]

        @slider.on_update
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
            player.step({"− 1 tick": -1, "+ 1 tick": 1, "+ 10 ticks": 10}[event.target.value])

        @jump.on_click
        async def _(_: Any) -> None:
            if not player.jump():
                self._page.say("no contact after this")


async def _elsewhere(function: Callable[..., T], *arguments: Any) -> T:
    """Call what takes long in another thread."""
    return await asyncio.get_running_loop().run_in_executor(None, function, *arguments)


def _add_episode(server: viser.ViserServer, actions: Actions, say: Callable[[str], None]) -> None:
    gui = server.gui
    gui.add_markdown("Simulation only: the arm is stopped, and all nodes start again with this scene.")
    names = scene_names()
    scene = gui.add_dropdown("Scene", names, initial_value="ball" if "ball" in names else names[0])
    seed = gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)
    restart = gui.add_button("Restart episode", icon=viser.Icon.RELOAD)

    @restart.on_click
    async def _(_: Any) -> None:
        say(await _elsewhere(actions.restart, str(scene.value), int(seed.value)))


class _TunePart:
    """Parameters of one node, as sliders where they have a range."""

    def __init__(self, server: viser.ViserServer, actions: Actions, say: Callable[[str], None]) -> None:
        self._gui = gui = server.gui
        self._actions = actions
        self._say = say
        self._inputs: dict[str, tuple[Parameter, Any]] = {}
        self._node = ""
        gui.add_markdown("Nodes read their parameters at the start: changes are applied by a restart of the stack.")
        node = gui.add_dropdown("Node", tuple(actions.nodes()))
        show = gui.add_button("Show parameters")
        self._apply = gui.add_button("Apply and restart", color="orange", visible=False)
        self._folder = gui.add_folder("Parameters", visible=False)

        @show.on_click
        async def _(_: Any) -> None:
            try:
                chosen = str(node.value)
                self._fill(chosen, await _elsewhere(actions.parameters, chosen))
            except ContactReachError as error:
                say(str(error))

        @self._apply.on_click
        async def _(_: Any) -> None:
            changed = {
                name: handle.value for name, (entry, handle) in self._inputs.items() if handle.value != entry.value
            }
            say(await _elsewhere(actions.apply, self._node, changed) if changed else "nothing is changed")

    def _fill(self, node: str, entries: Sequence[Parameter]) -> None:
        for _, handle in self._inputs.values():
            handle.remove()
        self._inputs, self._node = {}, node
        with self._folder:
            for entry in entries:
                self._inputs[entry.name] = (entry, _input(self._gui, entry))
        self._folder.visible = self._apply.visible = True


def _input(gui: Any, entry: Parameter) -> Any:
    value, low, high = entry.value, entry.minimum, entry.maximum
    if isinstance(value, bool):
        return gui.add_checkbox(entry.name, value, hint=entry.description)
    if isinstance(value, str):
        return gui.add_text(entry.name, value, hint=entry.description)
    if low is None or high is None or not low <= value <= high:
        return gui.add_number(entry.name, value, hint=entry.description)
    if isinstance(value, int):
        return gui.add_slider(entry.name, int(low), int(high), 1, value, hint=entry.description)
    # Fine enough for the present value too, which is often small within its range.
    step = 10.0 ** np.floor(np.log10(min(high - low, abs(value) or high - low) / 100.0))
    return gui.add_slider(entry.name, low, high, float(step), value, hint=entry.description)
