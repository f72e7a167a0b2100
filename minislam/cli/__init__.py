"""The commands, one file each; its `add_parser` adds them, and `main` lists the files."""
