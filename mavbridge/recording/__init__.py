"""A flight on disk: docs/flight_folder.md is the format.

    vision, action --emit--> Recorder (its own thread) --> FlightWriter --> ticks.arrows, link.tlog
                                                               |  frames through shared memory
                                                               v
                                                  writer process: camera.mp4, frames.arrows

``FlightWriter`` alone, in the offline mode, records what need not fly in real time
(demonstrations); ``VideoWriter`` alone makes one video of frames from anywhere (rollouts).
``open_flight`` reads it all back, after a crash as well. Nothing here is imported by the loops.
"""
