"""One process that compiles kernels for `processes.kernel_build`, a part of a scene at a time.

Standard input: the settings in JSON, the folder of contact tables (empty: none), then the name of
a part a line. Standard output, a line each: ``kernel NAME`` as one is begun, ``done`` when a part
is built, ``failed REASON`` when it can't be.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import Any


def main() -> None:
    """Build parts until standard input ends."""
    gc.set_threshold(100_000)  # the compiler makes much that lives: looking through it costs 10 %
    out = sys.stdout
    sys.stdout = sys.stderr  # whatever else prints, prints there

    def tell(line: str) -> None:
        print(line, file=out, flush=True)

    from numba.core import event as numba_event

    from softfinger.daemon.loop.warm_up import Scene, mark_built, named
    from softfinger.daemon.profile.settings import Settings

    events: Any = numba_event

    class Compiling(numba_event.Listener):
        def on_start(self, event: Any) -> None:
            tell(f"kernel {event.data['dispatcher'].py_func.__name__}")

        def on_end(self, event: Any) -> None:
            pass

    events.register("numba:compile", Compiling())
    head = sys.stdin.readline()
    if not head:
        return
    settings = Settings.model_validate_json(head)
    cache = sys.stdin.readline().rstrip("\n")
    scene = Scene(settings, Path(cache) if cache else None)
    for line in sys.stdin:
        part = named(line.rstrip("\n"))
        try:
            part.run(scene)
        except Exception as error:
            tell(f"failed {type(error).__name__}: {error}".replace("\n", " "))
        else:
            mark_built(part)
            tell("done")


if __name__ == "__main__":
    main()
