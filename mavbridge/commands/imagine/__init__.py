"""Imagined flights: a decider and a world model, iteration by iteration, into a video.

    start (a flight) --> ObservationQueue --> Decider --16 actions--> world model --16 latent frames
                              ^                                              |          and states
                              '--- exe_steps of them; pixels if needed ------+
                                                                             v  bounded queue
                           rollout.mp4 <-- writer process <-- decode thread (or CUDA side stream)
                           rollout.parquet

``loop.rollout`` is the loop and does not use files. ``StreamedOutput`` writes its segments as they
come. Only the files grow with the number of iterations.
"""
