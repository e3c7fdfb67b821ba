"""Why an assistant did what it did: from the rows of a cell to facts, and from facts to words.

    episode = read_episode(find_cell(layout, "611a4993"), 3)
    story = tell(episode)               an episode: totals, runs of decisions under one gate, costs that no gate foresaw
    decision = look(episode, 57)        one decision: command, gates, plan, what then really happened
    story_lines(story, width, command)  in words; look_lines(decision, width) likewise
    as_json(story)                      for machines

Written for people who know their operators and not the paper; the paper's symbols and equation numbers stand in brackets.
"""
