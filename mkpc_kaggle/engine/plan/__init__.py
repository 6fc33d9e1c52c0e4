"""The plan of a run: finished work, the next work, and the blame for lost jobs.

The door is :func:`mkpc_kaggle.engine.plan.schedule.next_work`, a pure function of the state, the
costs, the budget and the crew. Nothing here uses a worker or an SQLite file.
"""
