"""Errors of the package; each message says what was wrong, what was expected and what to do."""


class ContactReachError(Exception):
    """Base of every error that this package raises on purpose."""


class SettingsError(ContactReachError):
    """A settings file, parameter or command-line value is unknown, of the wrong type or out of range."""


class InputError(ContactReachError):
    """A message or argument is refused: non-finite, of the wrong size, in an unknown frame, out of reach, ..."""


class FrameError(InputError):
    """A message is in another frame than the arm's base frame."""


class PlanningError(ContactReachError):
    """There is no plan: for example, a collision-free path does not exist or was not found in time."""


class SceneError(ContactReachError):
    """A scene cannot be loaded or built."""


class BagError(ContactReachError):
    """A bag cannot be written or read."""


class RenderingError(ContactReachError):
    """A picture cannot be rendered: for example, OpenGL does not work on this machine."""
