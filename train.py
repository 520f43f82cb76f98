"""Replay runs through an ensemble, online: predict, then learn, then save what was learned.

python train.py data=blueboat data.path=LOGS              logs
python train.py grid=aid                                  tune a member; learn=aid and search=aid, too
python train.py -m estimators.sift_map.memory=10,30       a sweep; or sweep=inputs, of configs/sweep

It is the command `usvlearn train`, from a checkout.
"""

if __name__ == "__main__":
    from usvlearn.cli.main import begin

    begin("train")  # first words, before what takes a second to import
    from usvlearn.cli.train import main

    main()
