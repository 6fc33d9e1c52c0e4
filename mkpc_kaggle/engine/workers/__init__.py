"""Workers: a place takes one job, answers once, or loses its worker.

The door is :class:`mkpc_kaggle.engine.workers.places.Place`: ``submit(job)``, ``poll(now)``,
``kill()``. Behind it are threads, processes and Ray's actors, and the work itself.
"""
