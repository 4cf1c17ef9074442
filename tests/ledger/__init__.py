"""The ledger: figures of all cases and scenes, kept exactly, so that a change shows what it makes better and worse."""
