"""Train a formulation of contact: python train.py [key=value ...]

conf/train.yaml says what can be set. Installed, the same command is `lcplearn train`.
"""

from lcplearn.train import run

if __name__ == "__main__":
    run()
