"""Why an assistant did what it did: a stored episode (`episode`), what follows from its rows
(`facts`), both in words (`text`, laid out by `layout`), and the timeline of its gates (`timeline`).
"""
