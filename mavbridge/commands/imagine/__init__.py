"""Imagined flights: a decider and a world model, iteration by iteration, into a video.

    start (a flight) --> ObservationQueue --> Decider --16 actions--> world model --16 latent frames
                              ^                                              |          and states
                              '--- exe_steps of them; pixels if needed ------+
                                                                             v  bounded queue
                           rollout.mp4 <-- writer process <-- decode thread (or CUDA side stream)
                           rollout.parquet

``loop.rollout`` is the loop and knows no files; ``streamed`` and ``collected`` are what may become
of its segments: ours, and the plain serial reference, which give the same frames bit for bit.
Nothing grows with the number of iterations but the files.
"""
