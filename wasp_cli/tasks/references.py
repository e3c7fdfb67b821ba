"""Where a value of an env step is: `info.NAME`, `terminated`, or `module:function`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from wasp_cli.errors import TaskError

TERMINATED = "terminated"
_INFO = re.compile(r"info\.(?P<path>[^\s.:]+(\.[^\s.:]+)*)")
_FUNCTION = re.compile(
    r"(?P<module>[A-Za-z_]\w*(\.[A-Za-z_]\w*)*):(?P<name>[A-Za-z_]\w*)", re.ASCII
)
FORMS = (
    "write info.NAME for an entry of info, `terminated`, or module:function, which is called as "
    "function(env, action, info)"
)


@dataclass(frozen=True)
class Reference:
    """One of three forms; the others are empty."""

    text: str  # as it is written
    path: tuple[str, ...] = ()  # the names on the way to an entry of info
    module: str = ""
    function: str = ""

    @property
    def of_end(self) -> bool:
        """Whether it is `terminated`."""
        return not self.path and not self.module


def reference(text: str) -> Reference:
    """Read a reference. Raises TaskError where it has none of the three forms."""
    if text == TERMINATED:
        return Reference(text)
    if (match := _INFO.fullmatch(text)) is not None:
        return Reference(text, path=tuple(match["path"].split(".")))
    if (match := _FUNCTION.fullmatch(text)) is not None:
        return Reference(text, module=match["module"], function=match["name"])
    raise TaskError(f"'{text}' does not say where the value is", FORMS)
