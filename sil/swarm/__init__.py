"""The swarm: draws scenarios, checks the rules, and hands over the shortest scenario that breaks one."""
