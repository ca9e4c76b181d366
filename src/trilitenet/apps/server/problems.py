"""What the service answers when it does not answer the question: one shape for every refusal."""

from __future__ import annotations

import json

from starlette.requests import Request
from starlette.responses import Response

__all__ = ["BusyError", "ProblemError", "problem_response"]


class ProblemError(Exception):
    """A refusal with an HTTP status.

    Attributes:
        status: HTTP status code.
        code: A short word that programs can rely on.
        message: One line for people, with the cause and the cure.
        headers: Further response headers.
    """

    def __init__(self, status: int, code: str, message: str, headers: dict[str, str] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        self.message = message
        self.headers = headers or {}


class BusyError(ProblemError):
    """503 with Retry-After: the request was fine, the service has no room for it now."""

    def __init__(self, code: str, message: str, retry_after: int = 1) -> None:
        super().__init__(503, code, message, {"retry-after": str(retry_after)})


def problem_response(request: Request, problem: ProblemError) -> Response:
    """Write a problem as JSON: the Open Inference Protocol's form below ``/v2``, the service's own elsewhere."""
    body: dict[str, object]
    if request.url.path.startswith("/v2"):
        body = {"error": problem.message}
    else:
        identifier = request.scope.get("state", {}).get("request_id", "")
        body = {"error": {"code": problem.code, "message": problem.message, "request_id": identifier}}
    request.scope.setdefault("state", {})["problem"] = problem.code
    return Response(
        json.dumps(body, ensure_ascii=False),
        status_code=problem.status,
        headers=problem.headers,
        media_type="application/json",
    )
