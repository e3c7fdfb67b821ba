"""A results folder as pages (`wasp view`): `site` says what there is and where links lead,
`pages` and `episode` fill the templates.
"""
