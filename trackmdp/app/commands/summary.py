"""The table of a finished run at the terminal: its policy beside the references."""

from __future__ import annotations

from rich.console import Console

from trackmdp.policies.policy import Policy
from trackmdp.training.callbacks import Learning
from trackmdp.training.display import table
from trackmdp.training.run import Run


def show_summary(console: Console, trainer: Learning, run: Run) -> None:
    """The learned policy beside Q_MDP, all sensors on, and the optimum where it was solved for."""
    evaluator, solution = trainer.evaluator, run.solution
    policies = {f"learned ({trainer.config.algo.name})": run.evaluation}
    if evaluator.qmdp is not None:
        policies["Q_MDP"] = evaluator.qmdp
    policies["all on"] = evaluator.evaluate(Policy.all_on(evaluator.world))
    if solution is not None:
        policies["optimum" if solution.certified else "best known"] = solution.evaluation
    rows = [
        [name, f"{e.aihtr:,.3f}", f"{100 * e.accuracy:.2f} %", f"{e.sensors_per_step:.2f}"]
        for name, e in policies.items()
    ]
    rows.append(["upper bound", f"{evaluator.upper:,.3f}", "", ""])
    console.print(table("exact values", ["policy", "AIHTR", "accuracy", "sensors per step"], rows))
    console.print(trainer.evaluator.score(run.policy).regret)
    if solution is not None and solution.timed_out:
        console.print(f"optimum: {solution.ended}")
