"""A flight on disk: docs/formats.md is the format.

    vision loop, action loop --emit--> Recorder (its own thread) --> FlightWriter --> ticks
                                                                         |
                                      VideoWriter: frames through shared memory, rows by pipe
                                                                         v
                                   writer process: FrameFiles --> camera.mp4, frames
    process of the link --open_tlog_pipe--> writer process: TlogThread --> link.tlog

``FlightWriter`` alone, in the offline mode, records what need not fly in real time
(demonstrations); ``VideoWriter`` alone makes one video of frames from anywhere (rollouts).
``open_flight`` reads it all back, after a crash as well. The loops do not import this package.
"""
