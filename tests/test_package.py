"""What `import lcplearn` shows."""

import lcplearn


def test_dir_shows_what_there_is_to_use_and_nothing_else():
    assert dir(lcplearn) == sorted(["__version__", *lcplearn.__all__])
    assert all(hasattr(lcplearn, name) for name in dir(lcplearn))
