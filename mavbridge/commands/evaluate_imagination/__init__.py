"""``mavbridge imagine --evaluate``: how good a world model is, on flights that it was not shown.

    flights --choose--> Run (frames, states, sticks) --with_images--> WindowScorer --> tables, JSON
                                                                      drift.chain --'

Images and latents of one window are held at a time; of every window some kilobytes of numbers stay.
"""
