/* python.exe: the wheel that brings python311.dll has none. */
#include <wchar.h>

__declspec(dllimport) int Py_Main(int argc, wchar_t **argv);

int wmain(int argc, wchar_t **argv)
{
    /* MinGW's start code sets the x87 unit of this thread to extended precision; Windows has double in all threads. */
    unsigned short control = 0x27f;
    __asm__ volatile("fldcw %0" : : "m"(control));
    return Py_Main(argc, argv);
}
