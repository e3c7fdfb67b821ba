"""The leaderboard: an own assistant in the published worlds, as a folder that others can check.

`board` says which worlds count, `entry` what of a spec is submitted, `folder` what a submission
holds. `submit` writes one, `check` and `again` verify one, `lines` and `page` make the table.
docs/leaderboard.md has the rules.
"""
