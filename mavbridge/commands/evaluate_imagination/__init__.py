"""``mavbridge evaluate-imagination``: how good a world model is, on flights that it has not seen.

    flights --choose_windows--> FlightWindow (frames, states, sticks) --with_images--> scorers
                                                              scorers --> results (tables, JSON)

Images and latents of one window are held at a time; of every window some kilobytes of numbers stay.
"""
