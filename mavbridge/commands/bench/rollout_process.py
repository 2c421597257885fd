"""One rollout, measured: ``python -m mavbridge.commands.bench.rollout_process ...``.

Imports nothing before it is run: the writer process, which is spawned, imports this module again,
and would take torch into its memory and its start.
"""

if __name__ == "__main__":
    from mavbridge.commands.bench.rollout_trial import main

    main()
