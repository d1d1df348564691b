"""What the quick suite (-m "not slow") leaves to the whole one: shapes checked at each call, and many examples."""

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# But for lcp/solve.py and lcp/layer.py, which check their arguments themselves.
CHECKED = [f"lcplearn.lcp.{name}" for name in ("residuals", "interior_point", "gradient", "methods", "solution")]
CHECKED += ["lcplearn.scenes", "lcplearn.formulations", "lcplearn.datasets"]

settings.register_profile("quick", max_examples=20)


def pytest_configure(config: pytest.Config) -> None:
    if config.option.markexpr == "not slow":
        settings.load_profile("quick")
    else:
        install_import_hook(CHECKED, "beartype.beartype")  # it makes the tests take twice as long


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """As there is a worker for each core, threads of torch beside them would wait for one another, at full load."""
    import torch  # not before: who only hands tests to workers has no need of it

    torch.set_num_threads(1)


@pytest.fixture
def no_pause() -> None:
    """Threads are not paused by what ran before on a busy machine."""
    from lcplearn.lcp import threads

    threads._pause.end = 0.0
