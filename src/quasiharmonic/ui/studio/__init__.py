"""The browser application ``qhm studio``: a server, one worker process per browser tab, and the shared session logic.

The package builds on `solver` and `apps`. Start reading in `session`, then `server`.

- A message from a page passes through `server` and `page_worker`, encoded by `protocol`, to `session`. `validation`
  reads its fields.
- `session` computes a new `state` of the model (`surface`): by `setup` when the model is opened or unwrapped, by
  `operations` or `seams` later. `recipes` records the command and the script that make the same map.
- `updates` adds the state to the `history`, and sends `messages` about it. During a drag, `drag` moves the map.
- `history` also makes the files that the user saves. `page` has the files of the page itself, which are in ``static``.
"""
