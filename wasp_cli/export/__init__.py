"""Episodes for other libraries: the datasets of trainings, evaluated cells and people's sessions as
datasets of Minari and of LeRobot.

`selection` says which nodes are meant, `recorded` and `evaluated` read their episodes,
`minari_file` and `lerobot_file` write them; docs/formats.md has what each field holds. `hub` makes
a folder for a hub of published results.
"""
