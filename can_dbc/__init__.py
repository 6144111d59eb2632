"""The contract between plant and controller: messages, codec and end-to-end protection."""
