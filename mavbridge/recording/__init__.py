"""Recorded flights on disk, in the format of docs/formats.md.

    vision loop, action loop --emit--> Recorder (its own thread) --> FlightWriter --> ticks
                                                                         |
                                                 VideoWriter: frames through shared memory
                                                                         v
                                            writer process --> camera.mp4
    process of the link --open_tlog_pipe--> writer process --> link.tlog

``FlightWriter`` alone records flights that need not run in real time (demonstrations), and encodes
their images itself. ``open_flight`` reads a recording back, also after a crash. The loops do not
import this package.
"""
