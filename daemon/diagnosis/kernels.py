"""Compiled kernels: whether they can be kept, and whether those of a scene are there."""

from __future__ import annotations

from softfinger.daemon.diagnosis.result import Result
from softfinger.daemon.loop.warm_up import is_built, parts
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.compiled.kernel_cache import find_folder


def check_kernels(settings: Settings) -> list[Result]:
    """Whether compiled kernels can be kept, and whether those of this scene are there."""
    try:
        folder = find_folder()
    except (OSError, RuntimeError) as error:
        problem = f"can't be used, so every start compiles: {error}"
        fix = "export NUMBA_CACHE_DIR=FOLDER, one that is yours alone"
        return [Result("warn", "kernel cache", problem, fix)]
    cold = [part.name for part in parts(settings) if not is_built(part, settings)]
    if not cold:
        return [Result("pass", "kernels", f"compiled, in {folder}")]
    problem = f"{', '.join(cold)} not compiled yet: the next start takes longer"
    return [Result("warn", "kernels", problem, "softfinger compile, or just start it")]
