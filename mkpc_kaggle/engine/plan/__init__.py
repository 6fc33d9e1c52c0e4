"""The plan of a run: what is done, what comes next, and who is to blame for what was lost.

The door is :func:`mkpc_kaggle.engine.plan.schedule.next_work`, a pure function of the state, the
costs, the budget and the crew. Nothing here knows a worker or an SQLite file.
"""
