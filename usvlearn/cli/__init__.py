"""What train.py, evaluate.py and the command `usvlearn` do: the only room that knows Hydra and configs/."""
