from collections.abc import Callable
from typing import Any

constants: dict[str, float]

def __getattr__(name: str) -> Callable[..., Any]: ...
