"""Mutation testing of controller/ and can_dbc/: mutmut's operators, our tests, one fork for each mutant.

`python -m tests.mutation [MODULE...]`, e.g. `can_dbc.e2e` (nothing: all of both packages), prints the figures
by module and what is wrong with `survivors.toml`, which has to list every mutant that no test notices, with the
reason; 1 when one is missing there, or when a tenth survive.

All that mutmut can change is changed, what runs once at import and decorated functions included (mutmut's own
runner leaves both out). The tests are loaded once; each mutant is a fork of that process, in which its function
gets the changed code and everything kept in caches is forgotten. Where lines run while modules or tests are
loaded, the fork loads all of them anew. Then those tests run that reach the changed lines, the module's own
first and quick ones before slow ones, until one fails. Which test reaches which line is measured with coverage
and kept in `mutants/` while sources and tests stay the same.
"""
