"""The exceptions of tbmfg: one family, caught once in the command line.

A message is one line that holds what is wrong, the numbers, and the next move.
"""


class TbmfgError(Exception):
    """The input or the configuration is at fault (exit code 1)."""


class LogError(TbmfgError):
    """A recording that cannot be read, or that lacks what is needed."""


class RigError(TbmfgError):
    """A rig file that is refused; the message names the line and the reason."""


class EstimationError(TbmfgError):
    """A problem that the log and the rig do not determine; the message says which and what would."""


def reason(error: BaseException) -> str:
    """What went wrong, in one line; of what nobody foresaw also its kind."""
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.filename is not None:
        named = isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError | NotADirectoryError)
        return f"{error.filename}: {(error.strerror or 'cannot be used').lower()}" + "; check the name" * named
    if isinstance(error, TbmfgError | OSError):
        return text
    return f"internal error: {type(error).__name__}: {text}"
