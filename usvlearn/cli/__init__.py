"""What train.py and evaluate.py share: the only room that knows Hydra."""
