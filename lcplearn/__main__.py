"""python -m lcplearn: the version, and which commands there are."""

from importlib.metadata import version

COMMANDS = """
python train.py               learn a model (in the repository, beside conf/)
python -m lcplearn.predict    predict with a trained model, or score it
python -m lcplearn.compare    put runs side by side
python -m lcplearn.benchmark  speed against error of the LCP layer
Each explains itself with --help.
"""

if __name__ == "__main__":
    print(f"lcplearn {version('lcplearn')}\n{COMMANDS}", end="")
