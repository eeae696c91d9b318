"""Errors of the package: each says what was wrong, what was expected and what to do."""


class ContactReachError(Exception):
    """Base of every error that this package raises on purpose."""


class SettingsError(ContactReachError):
    """A settings file, parameter or command-line value is unknown, of the wrong type or out of range."""


class InputError(ContactReachError):
    """A message or argument is refused: non-finite, of the wrong size, in an unknown frame, out of reach, ..."""


class PlanningError(ContactReachError):
    """There is no plan: a collision-free path, say, does not exist or was not found in time."""


class SceneError(ContactReachError):
    """A scene cannot be loaded or built."""


class BagError(ContactReachError):
    """A bag cannot be written or read."""


class RenderingError(ContactReachError):
    """A picture cannot be made: the renderer is unknown or cannot be used on this machine, say."""
