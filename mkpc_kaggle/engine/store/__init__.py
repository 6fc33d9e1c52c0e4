"""The store of a run: each result under its key, and the same results as tables for people.

The doors are :class:`mkpc_kaggle.engine.store.database.Store` for the engine, and
:func:`mkpc_kaggle.engine.store.dataframes.results` for everybody else.
"""
