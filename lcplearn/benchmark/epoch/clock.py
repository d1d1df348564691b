"""CPU time by part of a program, where one part may call another: each moment counts for the innermost."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from inspect import getattr_static
from typing import Any
from unittest.mock import patch

Times = dict[str, float]


class Clock:
    """Adds up seconds of CPU time of this process by the part that runs."""

    def __init__(self, rest: str) -> None:
        self.seconds: Times = {}
        self._open = [rest]
        self._last = time.process_time()

    def read(self) -> Times:
        """Seconds by part since the clock was made."""
        self._switch()
        return dict(self.seconds)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What runs inside counts for this part, but for what it opens itself."""
        self._switch()
        self._open.append(name)
        try:
            yield
        finally:
            self._switch()
            self._open.pop()

    def _switch(self) -> None:
        now = time.process_time()
        self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._last
        self._last = now

    @contextmanager
    def timing(self, places: Iterable[tuple[str, Any, str]]) -> Iterator[None]:
        """Time functions and methods: (part, module or class, name)."""
        started = []
        try:
            for part, owner, name in places:
                found = getattr_static(owner, name)
                static = isinstance(found, staticmethod)
                timed = self._timed(part, found.__func__ if static else found)
                started.append(patch.object(owner, name, staticmethod(timed) if static else timed))
                started[-1].start()
            yield
        finally:
            for each in reversed(started):
                each.stop()

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def run(*arguments: Any, **keywords: Any) -> Any:
            with self.part(part):
                found = function(*arguments, **keywords)
            return self._each(part, found) if isinstance(found, Iterator) else found

        return run

    def _each(self, part: str, found: Iterator[Any]) -> Iterator[Any]:
        """An iterator's items, timed one by one."""
        while True:
            with self.part(part):
                try:
                    item = next(found)
                except StopIteration:
                    return
            yield item
