"""The installed command: lcplearn COMMAND [arguments], which is python -m lcplearn COMMAND.

lcplearn train [key=value ...] is python train.py without the repository: its configuration lies in the package.
"""

import runpy
import sys

from lcplearn import __version__

COMMANDS = {
    "train": ("lcplearn.train", "learn a model; in the repository also python train.py"),
    "predict": ("lcplearn.predict", "predict with a trained model, or score it"),
    "compare": ("lcplearn.compare", "put runs side by side"),
    "benchmark": ("lcplearn.benchmark", "speed against error of the LCP layer"),
    "get": ("lcplearn.datasets.get", "fetch recordings: slides, tosses, pushes"),
}


def main() -> None:
    """Run the command that was asked for as if it were the program."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in COMMANDS:
        del sys.argv[1]
        # As the main module, so that whoever starts this process again (Lightning's ddp) finds it.
        runpy.run_module(COMMANDS[name][0], run_name="__main__", alter_sys=True)
    elif name == "--version":
        print(f"lcplearn {__version__}")
    elif name in ("--help", "-h"):
        commands = "".join(f"  lcplearn {each:<9}  {what}\n" for each, (_, what) in COMMANDS.items())
        print(f"lcplearn {__version__}\n\n{commands}\nEach explains itself with --help.")
    else:
        sys.exit(f"lcplearn: expected a command ({', '.join(COMMANDS)}), got {name!r}")


if __name__ == "__main__":
    main()
