"""The software-in-the-loop side: coupling, scenarios, commands, pictures and reports."""
