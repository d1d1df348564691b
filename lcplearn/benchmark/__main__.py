"""Speed against error, from solvers to learned models.

Each command prints tables and writes results.csv, figures, a summary and a TensorBoard run to --output. A run that was
stopped continues where it was when the same command is given again.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

# Each is the module of that name, with run(options: Options).
STUDIES = {
    "solvers": "time against residual, forward and backward, for each method and peer",
    "acceptance": "each figure the layer must show, measured",
    "stability": "hard cases, sweeps of condition and scale, the noise study: where each method breaks",
    "scenes": "what a scene-minimal LCP saves, and error against step size and time",
    "engines": "the Stick Bench: scenes with an exact answer, beside physics engines",
    "models": "learned formulations: error against time, samples and noise",
    "pushes": "real pushes: gradients, times, how many a model needs, planning with a learned one",
    "tosses": "real tosses of a cube: learned bodies, simulators and a network on the same tosses; how many are needed",
    "overhead": "one problem a call, and memory",
    "growth": "one large problem: time, gradient and memory to n = 400",
    "threads": "what more threads gain, against the batch, on an idle machine and on a busy one",
    "devices": "problems a second on a CUDA device, beside the CPU kernel on all cores",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; what a user did wrong ends in one sentence."""
    options = _parser().parse_args(arguments)
    try:
        _run(options)
    except (ValueError, OSError) as error:
        sys.exit(f"benchmark {options.command}: {error}")
    except KeyboardInterrupt:
        sys.exit(f"benchmark {options.command}: stopped; the same command continues")


def _run(options: argparse.Namespace) -> None:
    if options.command == "report":
        from lcplearn.benchmark.harness.report import write_report

        write_report(options.folders, options.output)
        print(options.output)
        return
    # Before numpy and torch are imported, which read them.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(options.threads)
    import torch

    torch.set_num_threads(options.threads)
    if options.command in ("fuzz", "audit", "against", "epoch"):
        import_module(f"lcplearn.benchmark.{options.command}.run").run(options)
        return
    from lcplearn.benchmark.harness.study import Options

    default = Path("runs/benchmark") / (options.command + ("-quick" if options.quick else ""))
    chosen = Options(options.output or default, options.quick, options.threads, options.seed)
    import_module(f"lcplearn.benchmark.{options.command}.run").run(chosen)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m lcplearn.benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, what in STUDIES.items():
        command = commands.add_parser(name, help=what, description=what)
        command.add_argument("--output", type=Path, metavar="DIR", help="folder (default: runs/benchmark/COMMAND)")
        command.add_argument("--quick", action="store_true", help="small sizes, half a minute to two minutes")
        _add_threads_and_seed(command)
    fuzz = commands.add_parser("fuzz", help="hunt for wrong statuses, NaN, crashes and batch dependence")
    fuzz.add_argument("--minutes", type=_at_least(1), default=1, help="how long to hunt (default: 1)")
    fuzz.add_argument("--output", type=Path, default=Path("runs/benchmark/fuzz"), metavar="DIR", help="for findings")
    fuzz.add_argument("--replay", type=Path, metavar="FILE", help="check one finding again, instead of hunting")
    _add_threads_and_seed(fuzz)
    audit = commands.add_parser("audit", help="count wrong, missed and unproven answers over a million problems")
    audit.add_argument("--count", type=_at_least(1), default=1_000_000, metavar="N", help="problems (default: 1000000)")
    audit.add_argument("--precision", choices=("float64", "float32"), default="float64", help="of the data")
    audit.add_argument("--output", type=Path, metavar="DIR", help="folder (default: runs/benchmark/audit)")
    _add_threads_and_seed(audit)
    against = commands.add_parser("against", help="the kernel's speed beside that of another checkout, in turns")
    against.add_argument("tree", type=Path, metavar="TREE", help="folder of the other checkout")
    against.add_argument("--rounds", type=_at_least(1), default=9, metavar="N", help="of each family (default: 9)")
    _add_threads_and_seed(against)
    epoch = commands.add_parser("epoch", help="where the time of a training's epoch goes, part by part")
    epoch.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="as for train.py")
    _add_threads_and_seed(epoch)
    report = commands.add_parser("report", help="gather studies into one self-contained HTML page")
    report.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="folders that commands wrote")
    report.add_argument("--output", type=Path, default=Path("report.html"), metavar="FILE", help="default: report.html")
    return parser


def _add_threads_and_seed(command: argparse.ArgumentParser) -> None:
    command.add_argument("--threads", type=_at_least(1), default=1, metavar="N", help="of torch and BLAS (default: 1)")
    command.add_argument("--seed", type=_at_least(0), default=0, metavar="N", help="of what is generated (default: 0)")


def _at_least(smallest: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < smallest:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {smallest}; got {text!r}")
        return int(text)

    return parse


if __name__ == "__main__":
    main()
