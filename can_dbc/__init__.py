"""The contract between plant and controller: identifiers, messages, codec and end-to-end protection."""
