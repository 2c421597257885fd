"""First drafts of contract files: ``mavbridge contract``, and the file beside an export.

lerobot, onnx, recorded --entries--> entries.draft_text --> TOML for ``adapters.interface``
"""
