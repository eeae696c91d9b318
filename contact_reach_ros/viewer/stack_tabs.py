"""Tabs that restart the stack with another scene or other parameters."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.viewer.actions import Actions, Parameter
from contact_reach_ros.world.files import scene_names


def add_episode_controls(server: viser.ViserServer, actions: Actions, say: Callable[[str], None]) -> None:
    """Add scene, seed and the button that restarts the episode; `say` shows a line on the page."""
    gui = server.gui
    gui.add_markdown("Simulation only: the arm is stopped, and all nodes start again with this scene.")
    names = scene_names()
    scene = gui.add_dropdown("Scene", names, initial_value="ball" if "ball" in names else names[0])
    seed = gui.add_number("Seed", 0, min=0, max=2**31 - 1, step=1)
    restart = gui.add_button("Restart episode", icon=viser.Icon.RELOAD)

    @restart.on_click
    async def _(_: Any) -> None:
        say(await asyncio.to_thread(actions.restart, str(scene.value), int(seed.value)))


class TuneTab:
    """Parameters of one node, with sliders for those that have a range."""

    def __init__(self, server: viser.ViserServer, actions: Actions, say: Callable[[str], None]) -> None:
        self._gui = gui = server.gui
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
                self._fill(chosen, await asyncio.to_thread(actions.parameters, chosen))
            except ContactReachError as error:
                say(str(error))

        @self._apply.on_click
        async def _(_: Any) -> None:
            changed = {
                name: handle.value for name, (entry, handle) in self._inputs.items() if handle.value != entry.value
            }
            say(await asyncio.to_thread(actions.apply, self._node, changed) if changed else "nothing has changed")

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
    # Fine enough for the present value too, which is often small compared with its range.
    step = 10.0 ** np.floor(np.log10(min(high - low, abs(value) or high - low) / 100.0))
    return gui.add_slider(entry.name, low, high, float(step), value, hint=entry.description)
