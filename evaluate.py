"""Evaluate saved runs, or make a whole study.

python evaluate.py runs=outputs/RUN                 a report: errors, open-loop simulations, certificates, parameters
python evaluate.py runs=multirun/DIR                the jobs of a sweep: the leaderboard
python evaluate.py experiment=paper                 the paper's study from nothing, on a simulated fleet

It is the command `usvlearn evaluate`, from a checkout.
"""

if __name__ == "__main__":
    from usvlearn.cli.main import begin

    begin("evaluate")  # first words, before what takes a second to import
    from usvlearn.cli.evaluate import main

    main()
