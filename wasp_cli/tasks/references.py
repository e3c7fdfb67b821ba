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
    """One of the three forms: `path` is set, or `module` and `function`, or neither."""

    text: str  # as it is written
    path: tuple[str, ...] = ()  # of info.a.b: a, b
    module: str = ""
    function: str = ""

    @property
    def of_end(self) -> bool:
        """Whether it is `terminated`."""
        return not self.path and not self.module


def reference(text: str) -> Reference:
    """Return a text as a reference. Raises TaskError where it has none of the three forms."""
    if text == TERMINATED:
        return Reference(text)
    entry = _INFO.fullmatch(text)
    if entry is not None:
        return Reference(text, path=tuple(entry["path"].split(".")))
    function = _FUNCTION.fullmatch(text)
    if function is not None:
        return Reference(text, module=function["module"], function=function["name"])
    raise TaskError(f"'{text}' does not say where the value is", FORMS)
